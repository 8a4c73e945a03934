"""Some damaged inputs for each reader, drawn by hypothesis; `./run fuzz` feeds as many as one has time for."""

import os
import random
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from carstudio.errors import InputError
from fuzz.campaign import attempt, run_campaign
from fuzz.edits import KINDS, Edit, Files, apply, draw_edits
from fuzz.guided import unpack, write_corpus
from fuzz.minimise import minimise
from fuzz.target import Target, is_refused, make_input
from fuzz.targets import TARGETS

EXAMPLES = {"store": 60, "checkpoint": 60, "legacy": 60, "frame": 60}
KIND = st.sampled_from([*KINDS, "mend"])
EDIT = st.builds(Edit, KIND, st.integers(0, 9), st.integers(0, 300) | st.integers(0, 1 << 24), st.integers(0, 1 << 16))


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_read_or_refused_in_words(name: str, tmp_path: Path) -> None:
    """`is_refused` raises for anything but a sound value or an `InputError` with words; damage is refused at times."""
    target, outcomes = TARGETS[name], []
    seeds = target.seeds()

    @settings(max_examples=EXAMPLES.get(name, 200), phases=[Phase.generate])  # our own minimiser is quicker
    @given(st.lists(EDIT, max_size=6), st.integers(0, 99), st.integers(0, 99))
    def read(edits: list[Edit], seed: int, other: int) -> None:
        with TemporaryDirectory(dir=tmp_path) as folder:
            outcomes.append(is_refused(target, make_input(target, seeds, edits, seed, other), Path(folder)))

    read()
    assert not all(outcomes)
    assert any(outcomes) == (name != "frame")  # a build tells what is wrong with a frame and goes on


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_not_damaged_is_read(name: str, tmp_path: Path) -> None:
    target = TARGETS[name]
    for number, files in enumerate(target.seeds()):
        for mend in (lambda files: files, target.mend):
            folder = tmp_path / f"{number}-{mend is target.mend}"
            folder.mkdir()
            assert not is_refused(target, mend(files), folder)


def _touchy(files: Files, folder: Path) -> None:
    if b"7" not in files["a"]:
        raise KeyError("seven")
    if len(files["a"]) < 3:
        raise InputError("too short")
    if files["a"].startswith(b"\xff"):
        os.abort()


TOUCHY = Target("touchy", lambda: [{"a": b"4567"}, {"a": b"Car 7 nothing"}], _touchy)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_campaign_keeps_what_went_wrong_and_goes_on(jobs: int) -> None:
    tally = run_campaign(TOUCHY, inputs=1500, seed=0, jobs=jobs)
    assert tally.inputs == 1500
    assert tally.refused > 0
    kinds = sorted(signature.split(":")[0] for signature in tally.finds)
    assert kinds == ["KeyError at test_fuzz.py", "process ended by signal 6"]
    alone = run_campaign(TOUCHY, inputs=1500, seed=0, jobs=1)
    assert {name: sorted(find.index for find in finds) for name, finds in tally.finds.items()} == {
        name: [find.index for find in finds] for name, finds in alone.finds.items()
    }


def test_finds_are_made_small(tmp_path: Path) -> None:
    tally = run_campaign(TOUCHY, inputs=1500, seed=0, jobs=1)
    small = {
        name.split()[0]: minimise(TOUCHY, finds[0], seed=0, folder=tmp_path) for name, finds in tally.finds.items()
    }
    assert small["KeyError"] == {"a": b""}
    assert small["process"]["a"][:1] == b"\xff"
    assert len(small["process"]["a"]) == 3


def _greedy(files: Files, folder: Path) -> None:
    assert bytearray(16 * 2**30)


def test_an_input_that_asks_for_too_much_memory_is_a_find() -> None:
    tally = run_campaign(Target("greedy", lambda: [{"a": b"x"}], _greedy), inputs=2, seed=0, jobs=1)
    assert [signature.split()[0] for signature in tally.finds] == ["MemoryError"]


def _hang(files: Files, folder: Path) -> None:
    while True:
        pass


def test_a_reader_that_hangs_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fuzz.campaign.SECONDS", 0.2)
    is_no, signature, _ = attempt(Target("hang", lambda: [{}], _hang), {}, tmp_path / "x")
    assert not is_no
    assert signature.startswith("TooSlow at test_fuzz.py")


def test_edits_do_what_they_say_and_take_any_numbers() -> None:
    files = {"a": b"Car 1.5 2\nVan 7\n", "b": b""}
    assert apply([Edit("cut", 0, 3, 0)], files, files)["a"] == b"Car"
    assert apply([Edit("number", 0, 1, 2)], files, files)["a"] == b"Car 1.5 -1\nVan 7\n"
    assert apply([Edit("splice", 0, 4, 2)], files, {"a": b"xyz"})["a"] == b"Car z"
    rng = random.Random(0)
    for _ in range(300):
        assert apply(draw_edits(rng), files, {}).keys() == files.keys()


@pytest.mark.parametrize("name", ["labels", "frame", "store"])
def test_guided_inputs_are_files_again(name: str, tmp_path: Path) -> None:
    """Each corpus entry gives its seed back; any bytes are some input."""
    target = TARGETS[name]
    seeds = list(target.seeds())
    write_corpus(target, seeds, tmp_path)
    entries = sorted(tmp_path.iterdir())
    assert len(entries) == 2 * sum(len(files) for files in seeds)
    for entry in entries:
        index, _, mend = (int(part) for part in entry.name.split("-")[1:])
        expected = target.mend(dict(seeds[index])) if mend else seeds[index]
        assert unpack(target, seeds, entry.read_bytes()) == expected
    for data in (b"", b"\xff", bytes(range(7))):
        assert unpack(target, seeds, data).keys() >= {sorted(seeds[(data + b"\0")[0] % 128 % len(seeds)])[0]}
