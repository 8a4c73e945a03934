"""The frozen set comes out as written down: coarsely everywhere, to the bit with the pinned libraries."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from carstudio.dataset.sources.synthetic import (
    SynthConfig,
    car_records,
    coarse_content,
    content_digest,
    frozen_benchmark,
    synthesize,
)
from carstudio.dataset.store import open_store
from carstudio.images import decode_image, encode_png
from carstudio.synthetic.benchmark import BENCHMARK_SEED, BENCHMARK_SHA256, FIRST_CAR_SHA256, FIRST_VIEW

# mean colour (0-255), car pixels (the outline's may flip), depth (m), focal (px), box centre and size (m)
TOLERANCE = np.array([0.5, 0.5, 0.5, 6, 0.02, 0.05, *[0.002] * 6])


def test_the_first_car_is_the_one_written_down(tmp_path: Path) -> None:
    records = car_records(frozen_benchmark(tmp_path), [], 0)
    assert len(records) == 8
    difference = np.abs(np.array(coarse_content(records[:1])[0]) - np.array(FIRST_VIEW))
    assert (difference < TOLERANCE).all(), difference


def test_the_digest_sees_one_pixel_and_every_label(tmp_path: Path) -> None:
    config = SynthConfig(out=tmp_path, cars=1, views=1, size=32, seed=1)
    record = car_records(config, [], 0)[0]
    digest = content_digest([record])
    pixels = decode_image(record.image, name="image")
    assert content_digest([replace(record, image=encode_png(pixels))]) == digest
    pixels[3, 4, 1] ^= 1
    assert content_digest([replace(record, image=encode_png(pixels))]) != digest
    assert content_digest([replace(record, fx=record.fx + 1e-4)]) != digest


def test_no_default_uses_its_seed(tmp_path: Path) -> None:
    assert SynthConfig(out=tmp_path).seed != BENCHMARK_SEED


@pytest.mark.slow
def test_the_whole_set_is_the_one_written_down(tmp_path: Path) -> None:
    config = frozen_benchmark(tmp_path / "frozen")
    synthesize(config)
    store = open_store(config.out)
    records = [store.record(patch_id) for patch_id in store.patch_ids(kept=False)]
    assert content_digest(records[:8]) == FIRST_CAR_SHA256, "see synthetic/benchmark.py on other library versions"
    assert content_digest(records) == BENCHMARK_SHA256, "see synthetic/benchmark.py on other library versions"
