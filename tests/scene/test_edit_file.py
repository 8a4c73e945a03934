"""Edit files: what is wrong is named with its line and the nearest right word; nothing else ever comes out."""

import json
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from carstudio.errors import InputError
from carstudio.scene.edit_file import parse_edits, read_edit_file, write_edits
from carstudio.scene.edits import OPS

GOOD = """\
version: 1
edits:
  - op: insert  # drives
    car: track:6
    track: 12
    frame: path
    poses:
      - {at: 0, position_m: [12, 0.5]}
      - {at: 20, position_m: [36, 0.5, 1.6], yaw_deg: -3}
  - op: move
    track: 4
    frames: 5-30
    translation_m: [4, 0, -1.5]
    frame: car
  - {op: rotate, track: 5, yaw_deg: 90, frames: 7}
  - {op: resize, track: 7, scale: 1.2}
  - {op: delete, track: 3}
  - {op: replace, track: 2, car: sedan, size_m: [4, 1.5, 1.8]}
  - {op: recolour, track: 6, colour: "#1030c0"}
  - {op: recolour, track: 6, colour: [200, 10, 10], way: paper}
  - {op: recolour, track: 6, way: mix, car: track:4, amount: 0.5}
  - {op: trajectory, track: 1, frame: world, poses: [{at: 0, position_m: [0, 1, 2]}]}
"""


def test_a_good_file_says_what_it_means() -> None:
    edits = parse_edits(GOOD, name="e.yaml")
    assert [edit.op for edit in edits] == (
        ["insert", "move", "rotate", "resize", "delete", "replace", "recolour", "recolour", "recolour", "trajectory"]
    )
    assert edits[1].frames == (5, 30)
    assert edits[1].model_dump(exclude={"frames"}) == {
        "op": "move", "track": "4", "translation_m": (4.0, 0.0, -1.5), "frame": "car"
    }  # fmt: skip
    assert edits[2].frames == (7, 7)
    assert edits[0].where("poses") == "e.yaml line 7"


def dumped(text: str) -> list[dict[str, object]]:
    return [edit.model_dump() for edit in parse_edits(text, name="e")]


def test_json_says_the_same() -> None:
    assert dumped(json.dumps(yaml.safe_load(GOOD))) == dumped(GOOD)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    write_edits(tmp_path / "e.yaml", parse_edits(GOOD, name="e"))
    assert [edit.model_dump() for edit in read_edit_file(tmp_path / "e.yaml")] == dumped(GOOD)


def test_the_guides_edit_file_is_one(repo_root: Path) -> None:
    text = (repo_root / "docs/edit_a_log.md").read_text().split("```yaml\n")[1].split("```")[0]
    assert {edit.op for edit in parse_edits(text, name="edit_a_log.md")} == set(OPS)


EDIT = "version: 1\nedits:\n  - op: move\n    track: 4\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "e line 1: expected 'version: 1'"),
        ("version: 2\nedits: []", "e line 1: expected version: 1, found 2; update carstudio"),
        ("version: 1\nedit: []", "e line 2: unknown field 'edit'; did you mean 'edits'?"),
        ("version: 1", "edits must be a list, found None"),
        ("version: 1\nversion: 1", "e line 2: 'version' twice"),
        ("version: 1\nedits:\n  - op: mvoe", "e line 3: op must be one of .*found 'mvoe'; did you mean 'move'?"),
        ("version: 1\nedits:\n  - 3", "e line 3: op must be one of"),
        (EDIT + "    translaton_m: [1, 2, 3]", "e line 5: move has no field 'translaton_m'; did you mean 'transl"),
        (EDIT + "    translation_m: [1, x, 3]", r"e line 5: move: translation_m\.1: .*found 'x'"),
        (EDIT + "    translation_m: [1, .nan, 3]", "e line 5: .*finite"),
        (EDIT + "    translation_m:\n    - 1\n    - 2\n    - 1.0e+9", "e line 8: .*less than or equal"),
        (EDIT, "e line 3: move: translation_m: Field required"),
        (EDIT + "    translation_m: [1, 2, 3]\n    frames: 9-3", "e line 6: move: frames: .*not above B, found 9 > 3"),
        (EDIT + "    translation_m: [1, 2, 3]\n    frames: some", "e line 6: move: frames: expected frames A-B"),
        (EDIT + "    translation_m: [1, 2, 3]\n    frame: wrld", "e line 6: move: frame: .*found 'wrld'"),
        ("version: 1\nedits:\n  - {op: resize, track: 1}", "e line 3: resize: expected either size_m .* or scale"),
        ("version: 1\nedits:\n  - {op: recolour, track: 1}", "e line 3: recolour: way: paint needs a colour"),
        ("version: 1\nedits:\n  - {op: recolour, track: 1, way: mix}", "e line 3: recolour: way: mix needs a car"),
        (
            "version: 1\nedits:\n  - op: insert\n    car: a\n    poses:\n    - at: 0\n      position: [1, 2]",
            "e line 7: a pose has no field 'position'; did you mean 'position_m'?",
        ),
        ("a: &x [1]\nb: *x", "e line 1: anchors and aliases are not taken"),
        ("version: 1\nedits:\n  - {op: delete, track: !!python/name:os.system x}", "e line 3: expected a plain value"),
        ("version: [[[", "e line 1: not YAML"),
        ("[" * 3000, "e"),
        ("\0", "e: not YAML"),
    ],
)  # fmt: skip
def test_errors_name_line_and_way_out(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_edits(text, name="e")


def test_binary_files_and_missing_ones_are_told(tmp_path: Path) -> None:
    (tmp_path / "e.yaml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match="UTF-8"):
        read_edit_file(tmp_path / "e.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        read_edit_file(tmp_path / "gone.yaml")


WORDS = [
    *GOOD.split(),
    "~",
    "{",
    "}",
    "[",
    "]",
    ":",
    "-",
    "null",
    "true",
    "1e400",
    "0x7f",
    "2020-01-01",
    "&a",
    "*a",
    "|",
]


@given(st.data())
def test_damaged_files_are_refused_or_read(data: st.DataObject) -> None:
    lines = GOOD.splitlines()
    for _ in range(data.draw(st.integers(1, 3))):
        number = data.draw(st.integers(0, len(lines) - 1))
        words = lines[number].split(" ")
        place = data.draw(st.integers(0, len(words) - 1))
        words[place] = data.draw(st.one_of(st.sampled_from(WORDS), st.text(max_size=6)))
        lines[number] = " ".join(words)
    try:
        edits = parse_edits("\n".join(lines), name="e.yaml")
    except InputError as error:
        said = str(error)
        assert said.startswith("e.yaml")
        return
    assert all(edit.where().startswith("e.yaml line ") for edit in edits)
