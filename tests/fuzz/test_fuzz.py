"""A few hundred damaged files for each reader; `./run fuzz --inputs 100000` feeds as many as one has time for."""

import random
import warnings
from pathlib import Path

import pytest

from carstudio.errors import InputError
from fuzz.campaign import HungError, fuzz, time_limit
from fuzz.mutations import mutate
from fuzz.targets import TARGETS, Target

INPUTS = 300


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_read_or_refused_in_words(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Pillow's on damaged EXIF
        outcome = fuzz(TARGETS[name], INPUTS, seed=7)
    assert outcome.inputs == outcome.accepted + outcome.refused == INPUTS, outcome.crashes
    assert not outcome.crashes


def test_a_reader_that_fails_is_caught() -> None:
    def read(data: bytes, folder: Path) -> None:
        if b"7" not in data:
            raise KeyError("seven")
        if len(data) < 3:
            raise InputError("too short")

    outcome = fuzz(Target(lambda folder: [b"4567"], read), 200, seed=0)
    assert outcome.accepted > 0
    assert [kind.split()[0] for kind in outcome.crashes] == ["KeyError"]


def test_an_input_depends_on_seed_and_number_alone() -> None:
    first = [mutate(b"Car 1.5 2", random.Random(f"0:{i}")) for i in range(50)]
    again = [mutate(b"Car 1.5 2", random.Random(f"0:{i}")) for i in range(50)]
    assert first == again
    assert len(set(first)) > 30


def hang() -> None:
    while True:
        pass


def test_a_reader_that_hangs_is_stopped() -> None:
    with pytest.raises(HungError), time_limit(1):
        hang()
