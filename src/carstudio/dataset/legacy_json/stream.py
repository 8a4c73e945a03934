"""Reading the authors' json record by record, in bounded memory, with the text between the records.

`{"dataset_name": "km", "instances": [{...}, {...}]}`: every record keeps its exact text, and so does what stands before
the first, between two, and after the last, so that a file can be written back byte by byte.
"""

import codecs
import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from carstudio.errors import InputError

MAX_RECORD = 1 << 20  # characters of one record, and of the text between two; the authors' records have some 600
_CHUNK = 1 << 20  # bytes read at once
_SPACE = re.compile(r"[ \t\n\r]*")
_DECODER = json.JSONDecoder()
_BYTE_ORDER_MARK = "\ufeff"


@dataclass(frozen=True)
class RawInstance:
    """One entry of `instances`. `before`: the text since the previous entry, or since the start of the file."""

    index: int
    before: str
    text: str
    value: Any  # as `json` parses the text
    after: str = ""  # of the last entry: the text up to the end of the file


@dataclass(frozen=True)
class LegacyFile:
    """One json that was read through once: it is well-formed."""

    path: Path
    dataset_name: str
    num_instances: int
    sha256: str


class _Text:
    """A window over a text file: at least `MAX_RECORD` characters lie ahead of `position`, or all there are."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
        self.digest = hashlib.sha256()
        self._file = file
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        self._buffer = ""
        self.position = 0
        self._mark = 0  # text from here on is kept
        self._lines = 1  # line and column where the buffer starts
        self._column = 1
        self._at_end = False
        self._fill()

    def _fill(self) -> None:
        """Read on until enough lies ahead; forget what stands before the mark."""
        while len(self._buffer) - self.position < MAX_RECORD and not self._at_end:
            if self.position - self._mark > MAX_RECORD:
                raise self.error(f"expected the next record after at most {MAX_RECORD} characters, found more text")
            chunk = self._file.read(_CHUNK)
            self.digest.update(chunk)
            self._at_end = not chunk
            self._lines, self._column = self.line_and_column(self._mark)
            try:
                more = self._decoder.decode(chunk, final=self._at_end)
            except UnicodeDecodeError as error:
                raise InputError(
                    f"{self.path}: expected UTF-8 text, found {error.reason} after line {self._lines}"
                ) from error
            self._buffer = self._buffer[self._mark :] + more
            self.position -= self._mark
            self._mark = 0

    def line_and_column(self, position: int) -> tuple[int, int]:
        """Of a place in the buffer, both counted from 1."""
        newlines = self._buffer.count("\n", 0, position)
        if newlines:
            return self._lines + newlines, position - self._buffer.rfind("\n", 0, position)
        return self._lines, self._column + position

    def error(self, message: str, position: int | None = None) -> InputError:
        """What is wrong, with line and column."""
        line, column = self.line_and_column(self.position if position is None else position)
        return InputError(f"{self.path} line {line} column {column}: {message}")

    def peek(self) -> str:
        """The next character that is no space; "" at the end of the file."""
        while True:
            found = _SPACE.match(self._buffer, self.position)
            assert found is not None  # matches the empty string too
            self.position = found.end()
            if self.position < len(self._buffer):
                self._fill()
                return self._buffer[self.position]
            self._fill()
            if self.position == len(self._buffer):
                return ""

    def expect(self, character: str, what: str) -> None:
        """Step over one character."""
        found = self.peek()
        if found != character:
            raise self.error(f"expected {character!r} {what}, found {repr(found) if found else 'the end of the file'}")
        self.position += 1

    def skip(self, character: str) -> bool:
        """Step over the character if it comes next."""
        found = self.peek() == character
        self.position += found
        return found

    def value(self) -> Any:
        """Step over one JSON value."""
        self.peek()
        start = self.position
        try:
            value, self.position = _DECODER.raw_decode(self._buffer, start)
        except json.JSONDecodeError as error:
            is_cut = not self._at_end and len(self._buffer) - start >= MAX_RECORD
            note = f" (a value may have {MAX_RECORD} characters at most)" if is_cut else ""
            raise self.error(f"expected JSON, found something else: {error.msg}{note}", error.pos) from error
        except RecursionError as error:
            raise self.error("expected JSON, found brackets nested too deep") from error
        except ValueError as error:  # an integer of thousands of digits
            raise self.error(f"expected JSON with ordinary numbers: {error}") from error
        if self.position - start > MAX_RECORD:
            raise self.error(
                f"expected values of at most {MAX_RECORD} characters, found {self.position - start}", start
            )
        return value

    def take(self) -> str:
        """The text since the last `take`."""
        text = self._buffer[self._mark : self.position]
        self._mark = self.position
        return text

    def instances(self) -> Iterator[RawInstance]:
        """The entries of the list that comes next; the text after the list is not taken."""
        self.expect("[", "to open the list of instances")
        if self.skip("]"):
            return
        index, more = 0, True
        while more:
            self.peek()
            before = self.take()
            value = self.value()
            yield RawInstance(index, before, self.take(), value)
            more = self.skip(",")
            index += 1
        self.expect("]", "or ',' after an instance")


@dataclass
class _Header:
    """What the top level says beside the instances."""

    dataset_name: Any = None
    has_instances: bool = False


def _walk(text: _Text, header: _Header) -> Iterator[RawInstance]:
    """All instances; the last one carries the text after it. Fills `header` on the way."""
    if text.peek() == _BYTE_ORDER_MARK:
        text.position += 1
    text.expect("{", "to open the object with dataset_name and instances")
    last = None
    more = not text.skip("}")
    while more:
        if text.peek() != '"':
            raise text.error(f"expected a key in double quotes, found {text.peek()!r}")
        key = text.value()
        text.expect(":", f"after the key {key!r}")
        if key != "instances":
            value = text.value()
            header.dataset_name = value if key == "dataset_name" else header.dataset_name
        elif header.has_instances:
            raise text.error("expected one list of instances, found a second")
        else:
            header.has_instances = True
            for instance in text.instances():
                if last is not None:
                    yield last
                last = instance
        more = text.skip(",")
        if not more:
            text.expect("}", "or ',' after a value")
    if text.peek():
        raise text.error("expected the end of the file, found more text after the object")
    if last is not None:
        yield RawInstance(last.index, last.before, last.text, last.value, text.take())


def read_instances(path: Path) -> Iterator[RawInstance]:
    """The entries of `instances` in order; `InputError` with line and column where the file is no such JSON."""
    with _open(path) as file:
        yield from _walk(_Text(path, file), _Header())


def scan_file(path: Path) -> LegacyFile:
    """Read a json through once: what it is, and that it is well-formed."""
    with _open(path) as file:
        text, header = _Text(path, file), _Header()
        count = sum(1 for _ in _walk(text, header))
        if not header.has_instances:
            raise InputError(f"{path}: expected the keys dataset_name and instances, found no instances")
        if not isinstance(header.dataset_name, str):
            raise InputError(f"{path}: expected dataset_name to be a text, found {header.dataset_name!r}")
        return LegacyFile(path, header.dataset_name, count, text.digest.hexdigest())


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected the authors' json") from error
