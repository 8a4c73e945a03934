"""Hashes, thumbnails and the search for like pictures, against slow loops over every pair and bit."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carstudio.dataset.fingerprints import (
    Fingerprints,
    Likeness,
    difference_hash,
    hamming,
    near_pairs,
    thumbnail,
)
from carstudio.images import decode_image, encode_jpeg
from dataset.made_up_patches import photo

WORDS = st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=20)


def prints_of(pictures: list[np.ndarray]) -> Fingerprints:
    return Fingerprints(
        np.array([difference_hash(picture) for picture in pictures], np.uint64),
        np.stack([thumbnail(picture) for picture in pictures]),
        np.array([picture.shape[1] / picture.shape[0] for picture in pictures]),
    )


def test_the_hash_by_hand() -> None:
    """A picture of 9 x 8 px that rises to the right in its first row only; then the same with the last step down."""
    picture = np.zeros((8, 9, 3), np.uint8)
    picture[0] = np.arange(9)[:, None] * 20
    assert difference_hash(picture) == 0xFF << 56
    picture[0, 8] = 0
    assert difference_hash(picture) == 0xFE << 56
    assert difference_hash(np.full((8, 9, 3), 7, np.uint8)) == 0


@given(WORDS, WORDS)
def test_hamming_counts_bits(a: list[int], b: list[int]) -> None:
    found = hamming(np.array(a, np.uint64), np.array(b, np.uint64))
    assert found.tolist() == [[(x ^ y).bit_count() for y in b] for x in a]


def slow_pairs(prints: Fingerprints, likeness: Likeness) -> list[list[int]]:
    pairs = []
    for i in range(len(prints.hashes)):
        for j in range(i + 1, len(prints.hashes)):
            thumbs = [prints.thumbnails[k].reshape(-1, 3).astype(float) for k in (i, j)]
            if min(np.sqrt(((t - t.mean(0)) ** 2).mean()) for t in thumbs) < 2:
                continue
            x, y = ((t - t.mean(0)).ravel() for t in thumbs)
            stretch = prints.shapes[i] / prints.shapes[j]
            is_near = (
                (int(prints.hashes[i]) ^ int(prints.hashes[j])).bit_count() <= likeness.max_distance
                and x @ y / np.linalg.norm(x) / np.linalg.norm(y) >= likeness.min_correlation
                and max(stretch, 1 / stretch) <= likeness.max_stretch + 1e-9
            )
            pairs += [[i, j]] if is_near else []
    return pairs


@pytest.mark.parametrize("seed", range(8))
def test_pairs_are_those_of_the_slow_loop(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Families of hashes and thumbnails that differ by some bits and levels; blocks smaller than the families."""
    monkeypatch.setattr("carstudio.dataset.fingerprints._BLOCK", 16)
    rng = np.random.default_rng(seed)
    count = 90
    hashes = rng.integers(0, 2**64, 6, dtype=np.uint64)[rng.integers(0, 6, count)]
    for k in range(count):
        for bit in rng.choice(64, rng.integers(0, 10), replace=False):
            hashes[k] ^= np.uint64(1) << np.uint64(bit)
    base = rng.integers(40, 215, (4, 192))
    base[3] = 128  # a flat family
    levels = base[rng.integers(0, 4, count)] + rng.normal(0, 1, (count, 192)) * rng.choice([0, 8, 20], (count, 1))
    prints = Fingerprints(hashes, levels.clip(0, 255).astype(np.uint8), rng.choice([1.0, 1.05, 1.1, 1.2], count))
    likeness = Likeness(max_distance=10)
    expected = slow_pairs(prints, likeness)
    assert near_pairs(prints, likeness).tolist() == expected
    assert 5 < len(expected) < 2000


def test_no_pictures_no_pairs() -> None:
    empty = Fingerprints(np.zeros(0, np.uint64), np.zeros((0, 192), np.uint8), np.zeros(0))
    assert near_pairs(empty, Likeness()).shape == (0, 2)


def brighter(picture: np.ndarray, factor: float) -> np.ndarray:
    return np.clip(np.round(picture * factor), 0, 255).astype(np.uint8)


def scaled(picture: np.ndarray, factor: float) -> np.ndarray:
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return cv2.resize(picture, None, fx=factor, fy=factor, interpolation=method)


@pytest.mark.parametrize("seed", range(6))
def test_copies_match_and_others_do_not(seed: int) -> None:
    pictures = [photo(100 * seed + k, 150, 100) for k in range(12)]
    first = pictures[0]
    copies = [
        decode_image(encode_jpeg(first, quality=50), name="copy"),
        scaled(first, 0.5),
        scaled(first, 1.5),
        brighter(first, 1.1),
        brighter(first, 0.9),
        np.ascontiguousarray(first[1:-1, 1:-2]),  # 2 %
    ]
    pairs = near_pairs(prints_of([*pictures, *copies]), Likeness()).tolist()
    alike = [0, *range(12, 18)]
    assert pairs == [[i, j] for i in alike for j in alike if i < j]


def test_a_mirrored_picture_is_another() -> None:
    picture = photo(5, 150, 100)
    assert len(near_pairs(prints_of([picture, np.ascontiguousarray(picture[:, ::-1])]), Likeness())) == 0
