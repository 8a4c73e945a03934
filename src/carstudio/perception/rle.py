"""COCO's run-length masks: columns from left to right, runs of 0 and 1 in turn, beginning with 0.

Runs stand as a list of numbers, or compressed in a text: from the fourth on each run is the difference to the one two
before it, in groups of five bits, lowest first, as characters from "0" on; 32 marks that more follow (COCO's API).
"""

from typing import Any

import numpy as np
from jaxtyping import Bool

from carstudio.errors import InputError
from carstudio.images import MAX_IMAGE_PIXELS

_GROUP_BITS, _MORE, _SIGN = 5, 0x20, 0x10


def decode_rle(value: Any, *, name: str) -> Bool[np.ndarray, "height width"]:
    """The mask of {"size": [height, width], "counts": list or text}; `InputError` says what is wrong with it."""
    size, counts = (value.get("size"), value.get("counts")) if isinstance(value, dict) else (None, None)
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(side, int) and side > 0 for side in size)):
        raise InputError(
            f'{name}: expected run lengths {{"size": [height, width], "counts": ...}}, found {value!r:.80}'
        )
    height, width = size
    if height * width > MAX_IMAGE_PIXELS:
        raise InputError(f"{name}: a mask of {width} x {height} pixels; at most {MAX_IMAGE_PIXELS:,} are read")
    runs = runs_from_text(counts, name=name) if isinstance(counts, str) else counts
    if not isinstance(runs, list) or not all(isinstance(run, int) and run >= 0 for run in runs):
        raise InputError(f"{name}: run lengths must be whole numbers from 0 on, found {counts!r:.80}")
    if sum(runs) != height * width:
        raise InputError(f"{name}: run lengths must add up to {height} x {width} pixels, found {sum(runs)}")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(width, height).T


def runs_from_text(text: str, *, name: str) -> list[int]:
    """Run lengths of the compressed form."""
    runs: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift > 8 * _GROUP_BITS:
            raise InputError(f"{name}: {character!r} does not belong in compressed run lengths")
        value |= (bits & 0x1F) << shift
        shift += _GROUP_BITS
        if bits & _MORE:
            continue
        if bits & _SIGN:
            value -= 1 << shift
        runs.append(value + runs[-2] if len(runs) > 2 else value)
        value = shift = 0
    if shift:
        raise InputError(f"{name}: the compressed run lengths end in the middle of a number")
    return runs


def text_from_runs(runs: list[int]) -> str:
    """Inverse of `runs_from_text`."""
    characters = []
    for index, run in enumerate(runs):
        value = run - runs[index - 2] if index > 2 else run
        while True:
            bits, value = value & 0x1F, value >> _GROUP_BITS
            is_last = value == (-1 if bits & _SIGN else 0)
            characters.append(chr((bits if is_last else bits | _MORE) + 48))
            if is_last:
                break
    return "".join(characters)


def encode_rle(mask: Bool[np.ndarray, "height width"]) -> dict[str, Any]:
    """The compressed form of a mask."""
    flat = mask.T.reshape(-1)
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    runs = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    if flat.size and flat[0]:
        runs = [0, *runs]
    return {"size": list(mask.shape), "counts": text_from_runs(runs)}
