"""The json is read in pieces: the same instances as `json.loads` gives, the same text, clear errors, bounded memory."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from carstudio.dataset.legacy_json import stream
from carstudio.dataset.legacy_json.stream import read_instances, scan_file
from carstudio.errors import InputError

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=10,
)
STYLES: list[dict[str, Any]] = [{}, {"indent": 1}, {"ensure_ascii": False}, {"separators": (",", ":")}]


@given(st.lists(JSON, max_size=12), JSON, st.booleans(), st.sampled_from(STYLES), st.integers(3, 40))
def test_pieces_put_together_are_the_file(
    tmp_path_factory: pytest.TempPathFactory, instances: list[Any], other: Any, is_first: bool, style: Any, chunk: int
) -> None:
    value = {"other": other, "dataset_name": "km"} if is_first else {"dataset_name": "km"}
    value["instances"] = instances
    value |= {"z": other}
    text = json.dumps(value, **style) + "\n"
    path = tmp_path_factory.mktemp("stream") / "km.json"
    path.write_text(text, encoding="utf-8", newline="")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream, "_CHUNK", chunk)  # characters and numbers are cut in two
        patch.setattr(stream, "MAX_RECORD", 20_000)
        file = scan_file(path)
        found = list(read_instances(path))
    assert (file.dataset_name, file.num_instances) == ("km", len(instances))
    assert [raw.value for raw in found] == instances
    assert [raw.index for raw in found] == list(range(len(instances)))
    if instances:
        assert "".join(raw.before + raw.text for raw in found) + found[-1].after == text


BAD = [
    ('{"dataset_name": "km", "instances": [\n{"a": 1,}\n]}', "line 2 column 9: expected JSON, found something else"),
    ('{"dataset_name": "km", "instances": [{"a": 1}\n\n  {"a": 2}]}', "line 3 column 3: expected ']' or ',' after an"),
    (
        '{"dataset_name": "km", "instances": [{"a": 1}',
        "line 1 column 46: expected ']' or ',' after an instance, found the",
    ),
    ('{"dataset_name": "km"\n "instances": []}', "line 2 column 2: expected '}' or ',' after a value, found '\"'"),
    ('{"dataset_name": "km", "instances": []} x', "column 41: expected the end of the file, found more text"),
    ('{"dataset_name": "km", "instances": {}}', "column 37: expected '[' to open the list of instances, found '{'"),
    ('{"dataset_name": "km", "instances": [], "instances": []}', "expected one list of instances, found a second"),
    ('{"dataset_name": "km", instances: []}', "column 24: expected a key in double quotes, found 'i'"),
    ('{"dataset_name" "km"}', "column 17: expected ':' after the key 'dataset_name', found '\"'"),
    ('{"dataset_name": "km"}', "found no instances"),
    ('{"instances": []}', "expected dataset_name to be a text, found None"),
    ('{"dataset_name": 7, "instances": []}', "expected dataset_name to be a text, found 7"),
    ('[{"patch": 1}]', "line 1 column 1: expected '{' to open the object with dataset_name and instances, found '['"),
    ("", "expected '{' to open the object with dataset_name and instances, found the end of the file"),
    ('{"dataset_name": "km", "instances": [' + "[" * 100_000, "line 1 column 38: expected JSON, found"),
    ('{"dataset_name": "km", "instances": [' + "9" * 5000 + "]}", "expected JSON with ordinary numbers"),
    ('{"dataset_name": "km", "instances": ["' + "x" * 2**21 + '"]}', "may have 1048576 characters at most"),
    ('{"dataset_name": "km",' + " " * 2**22 + '"instances": []}', "expected the next record after at most 1048576"),
]


@pytest.mark.parametrize(("text", "message"), BAD, ids=[message[:40] for _, message in BAD])
def test_malformed_files_are_told_with_line_and_column(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "km.json"
    path.write_text(text, encoding="utf-8", newline="")
    with pytest.raises(InputError) as caught:
        scan_file(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300


def test_line_and_column_hold_far_into_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "_CHUNK", 64)
    monkeypatch.setattr(stream, "MAX_RECORD", 100)
    lines = ['{"dataset_name": "km", "instances": [', *['{"a": "ü"},'] * 300, '{"a": 1, "b" 2}', "]}"]
    (tmp_path / "km.json").write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(InputError, match="line 302 column 14: expected JSON"):
        scan_file(tmp_path / "km.json")
    (tmp_path / "one.json").write_text("".join(lines), encoding="utf-8")
    with pytest.raises(InputError, match=f"line 1 column {len(lines[0]) + 300 * 11 + 14}: expected JSON"):
        scan_file(tmp_path / "one.json")


def test_no_utf8_is_told(tmp_path: Path) -> None:
    (tmp_path / "km.json").write_bytes(b'{"dataset_name": "km",\n "x": "\xff"}')
    with pytest.raises(InputError, match=r"km\.json: expected UTF-8 text, found invalid start byte"):
        scan_file(tmp_path / "km.json")


def test_a_byte_order_mark_is_kept(tmp_path: Path) -> None:
    (tmp_path / "km.json").write_text('\ufeff{"dataset_name": "km", "instances": [1]}', encoding="utf-8")
    assert [raw.before[0] for raw in read_instances(tmp_path / "km.json")] == ["\ufeff"]
