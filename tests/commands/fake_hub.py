"""A hub on this machine: serves the models of a folder (OWNER/MODEL/FILES) as huggingface.co does."""

import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Hub:
    """Its address, and the files that were sent."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.sent: list[str] = []
        self.cut: int | None = None  # send only so many bytes of weights, then hang up
        self.url = ""


class _Handler(BaseHTTPRequestHandler):
    hub: Hub  # set by a subclass per server

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        self._answer()

    def _answer(self) -> None:
        path = self.path.partition("?")[0].strip("/")
        if path == "":
            self._send(b"", {})
        elif path.startswith("api/models/"):
            self._describe(path.removeprefix("api/models/").split("/revision/")[0])
        else:
            name, _, rest = path.partition("/resolve/")
            self._send_file(self.hub.root / name, rest.partition("/")[2])

    def _describe(self, name: str) -> None:
        folder = self.hub.root / name
        if not folder.is_dir():
            self._send(b"{}", {"X-Error-Code": "RepoNotFound"}, status=404)
            return
        files = [{"rfilename": f.name, "size": f.stat().st_size} for f in sorted(folder.iterdir())]
        about = {"id": name, "modelId": name, "sha": COMMIT, "siblings": files, "private": False, "tags": []}
        self._send(json.dumps(about).encode(), {"Content-Type": "application/json"})

    def _send_file(self, folder: Path, name: str) -> None:
        file = folder / name
        if not file.is_file():
            code = "EntryNotFound" if folder.is_dir() else "RepoNotFound"
            self._send(b"", {"X-Error-Code": code}, status=404)
            return
        data = file.read_bytes()
        headers = {"ETag": f'"{hashlib.sha256(data).hexdigest()}"', "X-Repo-Commit": COMMIT}
        start, status, end = 0, 200, len(data)
        if asked := self.headers.get("Range"):
            start, status = int(asked.removeprefix("bytes=").split("-")[0]), 206
            headers["Content-Range"] = f"bytes {start}-{len(data) - 1}/{len(data)}"
        if self.command == "GET":
            self.hub.sent.append(file.name)
            if self.hub.cut is not None and file.suffix == ".safetensors":
                end = min(end, start + self.hub.cut)
                self.close_connection = True
        self._send(data[start:end], headers, status=status, promised=len(data) - start)

    def _send(self, data: bytes, headers: dict[str, str], status: int = 200, promised: int | None = None) -> None:
        self.send_response(status)
        for key, value in headers.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(data) if promised is None else promised))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serve(root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """Serve `root` in the hub's place, with `cache` for what is downloaded."""
    hub = Hub(root)
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": hub}))
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    hub.url = f"http://127.0.0.1:{server.server_port}"
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.url)
    template = f"{hub.url}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
    monkeypatch.setattr("huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(cache))
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
