"""What the store keeps of the authors' files in the column `extra`, so that they can be written again as they were.

`extra` is JSON: a few keys of ours and, last, `record` with the record's text, character by character.
"""

import base64
import binascii
import json
from dataclasses import dataclass
from typing import Any

from carstudio.errors import InputError

_KEYS = {"json", "dataset_name", "index", "before", "after", "mask_png"}


@dataclass(frozen=True, kw_only=True)
class Verbatim:
    """One record as it stood in its file."""

    json: str  # name of the file
    dataset_name: str
    index: int  # place among the file's instances, from 0
    before: str  # text since the previous record; of the first, since the start of the file
    after: str  # of the last record: text up to the end of the file
    text: str
    mask_png: bytes | None = None  # the mask's file, where the store's mask is not that very file


def pack_extra(verbatim: Verbatim) -> str:
    """The column `extra`."""
    return f'{_head(verbatim)}, "record": {verbatim.text}}}'


def _head(verbatim: Verbatim) -> str:
    head: dict[str, Any] = {
        "json": verbatim.json,
        "dataset_name": verbatim.dataset_name,
        "index": verbatim.index,
        "before": verbatim.before,
    }
    if verbatim.after:
        head["after"] = verbatim.after
    if verbatim.mask_png is not None:
        head["mask_png"] = base64.b64encode(verbatim.mask_png).decode()
    return json.dumps(head).removesuffix("}")


def unpack_extra(extra: str, *, where: str) -> Verbatim | None:
    """Inverse of `pack_extra`; None where the patch does not come from the authors' files."""
    try:
        value = json.loads(extra)
        if not isinstance(value, dict) or "record" not in value:
            return None
        head = {key: value[key] for key in _KEYS & value.keys()}
        mask_png = None if "mask_png" not in head else base64.b64decode(head.pop("mask_png"), validate=True)
        after = head.pop("after", "")
        verbatim = Verbatim(**head, after=after, text="", mask_png=mask_png)
        prefix = f'{_head(verbatim)}, "record": '
    except (ValueError, TypeError, RecursionError, binascii.Error) as error:
        raise InputError(f"{where}: extra is not what an import of the authors' files writes ({error})") from error
    texts = (verbatim.json, verbatim.dataset_name, verbatim.before, verbatim.after)
    is_sound = all(isinstance(text, str) for text in texts) and isinstance(verbatim.index, int)
    if not is_sound or not extra.startswith(prefix) or not extra.endswith("}"):
        raise InputError(f"{where}: extra is not what an import of the authors' files writes; import them again")
    return Verbatim(**{**vars(verbatim), "text": extra[len(prefix) : -1]})
