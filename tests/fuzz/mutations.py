"""Damage to a valid file: bytes flipped, cut, doubled and spliced, numbers and words replaced by hostile ones.

All chance comes from one `random.Random`: a seed gives the same input on every machine.
"""

import random
import re
from collections.abc import Callable

NUMBERS = (
    b"nan", b"-inf", b"Infinity", b"1e308", b"-1e308", b"1e-320", b"-0.0", b"0", b"-1", b"2147483648",
    b"18446744073709551616", b"9" * 400, b"1e999", b"0x10", b"1_000", b"",
)  # fmt: skip
WORDS = (
    b"null", b"true", b"[]", b"{}", b'""', b'"../../../etc/passwd"', b'"/etc/passwd"', b'"\\u0000"', b'"<script>"',
    b"[" * 5000, b'{"a":' * 2000, b"\xff\xfe", b"\x00", b"\r\n", b"\xc2\xa0", b"Infinity", b'[[1, 2], {"x": [3]}]',
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][+-]?\d+)?")
_VALUE = re.compile(rb'"[^"\\]{0,60}"|true|false|null|\d+')
_TOKEN = re.compile(rb"[^\s,:]+")


def mutate(seed: bytes, chance: random.Random) -> bytes:
    """One to four kinds of damage, one after another; at most 64 KiB longer than the seed."""
    data = seed
    for _ in range(chance.choice((1, 1, 1, 2, 2, 3, 4))):
        data = chance.choice(MUTATIONS)(data, chance)
    return data[: len(seed) + 65_536]


def _flip(data: bytes, chance: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 8))):
        if changed:
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def _overwrite(data: bytes, chance: random.Random) -> bytes:
    place, length = _span(data, chance)
    filling = chance.choice((b"\x00", b"\xff", b" ", b"9", bytes([chance.randrange(256)])))
    return data[:place] + filling * length + data[place + length :]


def _cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def _remove(data: bytes, chance: random.Random) -> bytes:
    place, length = _span(data, chance)
    return data[:place] + data[place + length :]


def _repeat(data: bytes, chance: random.Random) -> bytes:
    place, length = _span(data, chance)
    return data[:place] + data[place : place + length] * chance.choice((2, 3, 50)) + data[place + length :]


def _move(data: bytes, chance: random.Random) -> bytes:
    place, length = _span(data, chance)
    rest = data[:place] + data[place + length :]
    target = chance.randrange(len(rest) + 1)
    return rest[:target] + data[place : place + length] + rest[target:]


def _span(data: bytes, chance: random.Random) -> tuple[int, int]:
    place = chance.randrange(len(data) + 1)
    return place, chance.choice((1, 2, 4, 8, 64, chance.randrange(len(data) + 1)))


def _replace(pattern: re.Pattern[bytes], choices: tuple[bytes, ...]) -> Callable[[bytes, random.Random], bytes]:
    def replace(data: bytes, chance: random.Random) -> bytes:
        found = list(pattern.finditer(data[:65_536]))
        if not found:
            return _flip(data, chance)
        one = chance.choice(found)
        return data[: one.start()] + chance.choice(choices) + data[one.end() :]

    return replace


MUTATIONS: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip,
    _overwrite,
    _cut,
    _remove,
    _repeat,
    _move,
    _replace(_NUMBER, NUMBERS),
    _replace(_NUMBER, NUMBERS),
    _replace(_VALUE, WORDS + NUMBERS),
    _replace(_TOKEN, WORDS + NUMBERS),
)
