"""Structure-aware damage: an `Edit` says what to do to which file; any list of edits can be applied to any files.

An input is a set of files, name -> bytes. Edits take their numbers modulo what is there, so that a list of them can be
drawn by `random` (the command) or by hypothesis (the tests), shortened and replayed.
"""

import random
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

Files = dict[str, bytes]

NUMBERS = (
    *b"0 -0 -1 1 2 255 256 65535 65536 2147483647 -2147483648 4294967296 9223372036854775808 1e308 -1e308".split(),
    *b"1e-320 1e999 nan NaN inf -inf Infinity 0.5 1.5 1_0 0x10 1e5 -1000 3.4e38 1e19 1.7976931348623157e308".split(),
    *(b"9" * 5000, b"7" * 400),
)
TOKENS = (
    *(b"", b" ", b"\n", b"\t", b"\0", b"\xff", b"\r\n", b"\xe2\x80\xa8", b'"', b"\\", b":", b",", b"-"),
    *(b"null", b"true", b"[]", b"{}", b"[", b"{", b"}", b"]", b'""', b'"x"', b"[[[[[[[[", b"NaN", b"-1"),
    *(b"../", b"/etc/passwd", b"..", b"Car", b"DontCare", b"P2", b"P2:", b"F64", b"BF16", b"I64", b"%s%n", b"\xc3\xa9"),
)
INTEGERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 10_000, 120_000_000, 1 << 24)
_NUMBER = re.compile(rb"-?\d[\d.eE+_]*")
_WORD = re.compile(rb'"(?:[^"\\]|\\.)*"|[^\s,:{}\[\]"]+')


@dataclass(frozen=True)
class Edit:
    """One change: `kind` (a key of `KINDS`, or "mend") of file number `file`, at `place`, with `value`."""

    kind: str
    file: int
    place: int
    value: int


Change = Callable[[bytes, int, int, bytes], bytes]  # data, place, value, the same file of another seed -> data


def _set(data: bytes, place: int, value: int, other: bytes) -> bytes:
    at = place % max(1, len(data))
    return data[:at] + bytes([value % 256]) + data[at + 1 :]


def _flip(data: bytes, place: int, value: int, other: bytes) -> bytes:
    at = place % max(1, len(data))
    return data[:at] + bytes(byte ^ (1 << value % 8) for byte in data[at : at + 1]) + data[at + 1 :]


def _cut(data: bytes, place: int, value: int, other: bytes) -> bytes:
    return data[: place % (len(data) + 1)]


def _drop(data: bytes, place: int, value: int, other: bytes) -> bytes:
    at = place % (len(data) + 1)
    return data[:at] + data[at + 1 + value % 64 :]


def _repeat(data: bytes, place: int, value: int, other: bytes) -> bytes:
    at = place % (len(data) + 1)
    return data[:at] + data[at : at + 1 + value % 64] * (2 + value // 64 % 16) + data[at:]


def _nest(data: bytes, place: int, value: int, other: bytes) -> bytes:
    """Thousands of brackets: what a recursive parser does not survive."""
    at = place % (len(data) + 1)
    return data[:at] + (b"[", b'{"a":', b"(", b"\n")[value % 4] * 6000 + data[at:]


def _insert(data: bytes, place: int, value: int, other: bytes) -> bytes:
    at = place % (len(data) + 1)
    return data[:at] + TOKENS[value % len(TOKENS)] + data[at:]


def _number(data: bytes, place: int, value: int, other: bytes) -> bytes:
    return _replace(data, _NUMBER, place, NUMBERS[value % len(NUMBERS)])


def _word(data: bytes, place: int, value: int, other: bytes) -> bytes:
    return _replace(data, _WORD, place, TOKENS[value % len(TOKENS)])


def _swap(data: bytes, place: int, value: int, other: bytes) -> bytes:
    """One word becomes another word of the same file."""
    words = _WORD.findall(data[:20_000])
    return _replace(data, _WORD, place, words[value % len(words)]) if words else data


def _line(data: bytes, place: int, value: int, other: bytes) -> bytes:
    """A line twice, or out of its place."""
    lines = data.split(b"\n")
    line = lines[place % len(lines)]
    kept = lines if value % 2 else [*lines[: place % len(lines)], *lines[place % len(lines) + 1 :]]
    at = value // 2 % (len(kept) + 1)
    return b"\n".join([*kept[:at], line, *kept[at:]])


def _splice(data: bytes, place: int, value: int, other: bytes) -> bytes:
    return data[: place % (len(data) + 1)] + other[value % (len(other) + 1) :]


def _integer(data: bytes, place: int, value: int, other: bytes) -> bytes:
    """Four bytes become an integer that sizes and offsets go wrong with."""
    packed = struct.pack("<I" if value % 2 else ">I", INTEGERS[value // 2 % len(INTEGERS)])
    at = place % max(1, len(data))
    return data[:at] + packed + data[at + 4 :]


KINDS: dict[str, Change] = {
    "set": _set, "flip": _flip, "cut": _cut, "drop": _drop, "repeat": _repeat, "nest": _nest, "insert": _insert,
    "number": _number, "word": _word, "swap": _swap, "line": _line, "splice": _splice, "integer": _integer,
}  # fmt: skip


def _replace(data: bytes, pattern: re.Pattern[bytes], place: int, new: bytes) -> bytes:
    spans = [match.span() for match in pattern.finditer(data[:20_000])]
    if not spans:
        return data
    start, stop = spans[place % len(spans)]
    return data[:start] + new + data[stop:]


def apply(edits: Sequence[Edit], files: Files, other: Files) -> Files:
    """The files after all edits; `other` is what "splice" takes from."""
    changed = dict(files)
    for edit in edits:
        if edit.kind in KINDS:
            name = sorted(changed)[edit.file % len(changed)]
            changed[name] = KINDS[edit.kind](changed[name], edit.place, edit.value, other.get(name, b""))
    return changed


def draw_edits(rng: random.Random) -> list[Edit]:
    """One to eight edits, few more often than many; half of the time "mend" (checksums made right again) is last."""
    count = min(8, 1 + int(rng.expovariate(0.7)))
    kinds = list(KINDS)
    edits = [Edit(rng.choice(kinds), rng.randrange(64), _draw_place(rng), rng.randrange(1 << 16)) for _ in range(count)]
    return [*edits, Edit("mend", 0, 0, 0)] if rng.random() < 0.5 else edits


def _draw_place(rng: random.Random) -> int:
    """Anywhere, but every other time in the first bytes, where headers are."""
    return rng.randrange(1 << 30) if rng.random() < 0.5 else rng.randrange(200)
