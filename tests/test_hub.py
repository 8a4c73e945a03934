"""The hub: what is here is never asked for; a network that is slow, silent or refusing costs seconds, not minutes."""

import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from carstudio.hub import hub_answers, is_in_cache, load_from_hub
from carstudio.models.encoders import EncoderConfig, build_encoder, load_imagenet

NO_ANSWER = -1


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The questions that reached the server standing in for the hub."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return []


@pytest.fixture
def hub(request: pytest.FixtureRequest, asked: list[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A server on this machine in the hub's place; the parameter is its status, `NO_ANSWER` for silence."""
    is_over = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            asked.append(self.path)
            if request.param == NO_ANSWER:
                is_over.wait()
                return
            self.send_response(request.param)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", f"http://127.0.0.1:{server.server_port}")
    yield f"http://127.0.0.1:{server.server_port}"
    is_over.set()
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize(
    ("hub", "answers"), [(200, True), (404, True), (403, False), (407, False), (503, False)], indirect=["hub"]
)
def test_an_answer_counts_unless_a_proxy_refuses(hub: str, answers: bool, asked: list[str]) -> None:
    assert hub_answers() is answers
    assert len(asked) == 1  # one question, not five


@pytest.mark.parametrize("hub", [NO_ANSWER], indirect=True)
def test_silence_is_not_waited_for(hub: str, asked: list[str]) -> None:
    """The server answers only when this test is over: coming back at all is the proof."""
    assert hub_answers(patience_s=0.3) is False
    assert len(asked) == 1


def test_a_name_that_resolves_to_nothing_is_no_hub(asked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:  # bound, not listening: connections are refused
        taken.bind(("127.0.0.1", 0))
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", f"http://127.0.0.1:{taken.getsockname()[1]}")
        assert hub_answers() is False


@pytest.mark.parametrize("hub", [200], indirect=True)
def test_offline_asks_nobody(hub: str, asked: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert hub_answers() is False
    assert asked == []


@pytest.mark.parametrize(
    ("answers", "is_here", "expected"),
    [(True, True, ["local"]), (True, False, ["local", "hub"]), (False, True, ["local"]), (False, False, ["local"])],
)
def test_what_is_here_comes_first(
    answers: bool, is_here: bool, expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[str] = []

    def load(name: str, local_files_only: bool = False) -> str:
        tried.append("local" if local_files_only else "hub")
        if local_files_only and not is_here:
            raise OSError("not in the cache")
        return name

    monkeypatch.setattr("carstudio.hub.hub_answers", lambda: answers)
    if answers or is_here:
        assert load_from_hub(load, "a/model") == "a/model"
    else:
        with pytest.raises(OSError, match="not in the cache"):
            load_from_hub(load, "a/model")
    assert tried == expected


@pytest.mark.parametrize("hub", [503], indirect=True)
def test_training_starts_without_a_hub(hub: str, asked: list[str], caplog: pytest.LogCaptureFixture) -> None:
    config = EncoderConfig(pretrained="nobody/no-such-resnet")
    assert not is_in_cache("nobody/no-such-resnet")
    message = load_imagenet(build_encoder(config), config)
    assert message.startswith("random weights (nobody/no-such-resnet is not on this machine")
    assert len(caplog.records) == 1  # one warning, no retries
    assert len(asked) == 1
