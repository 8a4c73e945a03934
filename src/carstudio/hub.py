"""Weights of the Hugging Face hub: what is on this machine first, then the hub, if it answers within seconds.

Left to itself, huggingface_hub asks for every file, cached or not, and repeats each question five times: 24 s on a
machine without a network, minutes behind a firewall that drops packets.
"""

import threading
from collections.abc import Callable
from typing import TypeVar

Loaded = TypeVar("Loaded")
PATIENCE_S = 5.0  # a hub that answers does so in well under a second


def load_from_hub(load: Callable[..., Loaded], name: str) -> Loaded:
    """`load(name)` of transformers (`SomeModel.from_pretrained`): from a folder, the cache, or the hub, in this order.

    OSError when it is nowhere to be had. What is in the cache is taken as it is, even when the hub holds a newer one.
    """
    try:
        return load(name, local_files_only=True)
    except OSError:
        if not hub_answers():
            raise
    return load(name)


def hub_answers(patience_s: float = PATIENCE_S) -> bool:
    """Whether files could be downloaded: one question, at most `patience_s` of waiting; never when HF_HUB_OFFLINE."""
    from huggingface_hub import constants
    from huggingface_hub.utils import get_session

    statuses: list[int] = []

    def ask() -> None:
        try:
            statuses.append(get_session().head(constants.ENDPOINT, timeout=patience_s).status_code)
        except Exception:  # whatever the HTTP client raises (it refuses when HF_HUB_OFFLINE): there is no answer
            return

    # A thread that nobody waits for, because the look-up of a name takes no timeout.
    question = threading.Thread(target=ask, daemon=True)
    question.start()
    question.join(patience_s)
    return any(status < 500 and status not in (403, 407) for status in statuses)  # these two are a proxy's refusals


def is_in_cache(name: str) -> bool:
    """Whether a hub name's config and weights are on this machine."""
    from huggingface_hub import try_to_load_from_cache

    found = [try_to_load_from_cache(name, file) for file in ("config.json", "model.safetensors", "pytorch_model.bin")]
    return isinstance(found[0], str) and any(isinstance(path, str) for path in found[1:])
