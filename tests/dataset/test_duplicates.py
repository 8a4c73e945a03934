"""Duplicates in a store: found, written, kept on one side of the splits, dropped where the recipe says so."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carstudio.cli import run
from carstudio.dataset.duplicates import find_duplicates, group_patches, read_duplicates
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.judging import drop_repeats, judge_store
from carstudio.dataset.splits import View, join_units, kept_views, make_split, split_by_instance, split_by_view
from carstudio.dataset.splits import write_splits as write_standard_splits
from carstudio.dataset.store import PatchStore, open_store
from carstudio.dataset.verdicts import Verdict
from carstudio.errors import InputError
from carstudio.images import encode_jpeg
from dataset.made_up_patches import made_up_record, made_up_store
from oracles.copies_slow import flood

RECIPE = FilterRecipe(height_px=0.0, mask_ratio=0.0)


@pytest.fixture
def store(tmp_path: Path) -> PatchStore:
    """Twelve patches of four cars; 7 is 2's file again, 9 a JPEG of 0, 10 a JPEG of another quality of 0."""
    records = [made_up_record(i) for i in range(12)]
    records[7] = replace(records[7], image=records[2].image, sha256=records[2].sha256)
    for i, quality in ((9, 80), (10, 60)):
        image = encode_jpeg(records[0].decode().image, quality=quality)
        records[i] = replace(records[i], image=image, sha256=f"{i:064d}")
    return made_up_store(tmp_path / "s", records, recipe=RECIPE)


def test_finds_exact_and_near(store: PatchStore) -> None:
    found = find_duplicates(store)
    assert found == read_duplicates(store)
    assert found.groups() == {"p-00000": 0, "p-00009": 0, "p-00010": 0, "p-00002": 1, "p-00007": 1}
    assert found.firsts() == {"p-00009": "p-00000", "p-00010": "p-00000", "p-00007": "p-00002"}
    assert [kind for kind in found.kind if kind] == ["near", "exact", "exact", "near", "near"]
    assert found.counts() == {"groups": 2, "exact": 2, "near": 3, "repeating": 3}
    table = pq.read_table(store.path / "duplicates.parquet")
    assert len(set(table["phash"].to_pylist())) >= 8


def test_verify_knows_the_table(tmp_path: Path) -> None:
    store = made_up_store(tmp_path / "s", map(made_up_record, range(4)))
    find_duplicates(store)
    assert open_store(store.path).verify() == []
    table = pq.read_table(store.path / "duplicates.parquet")
    strange = table.set_column(0, table.schema.field(0), [["p-00000", "p-00001", "q", "p-00003"]])
    pq.write_table(strange, store.path / "duplicates.parquet")
    assert open_store(store.path).verify() == ["duplicates.parquet: patch q is not in the store"]


def test_workers_change_nothing(store: PatchStore) -> None:
    find_duplicates(store)
    first = (store.path / "duplicates.parquet").read_bytes()
    find_duplicates(store, workers=2)
    assert (store.path / "duplicates.parquet").read_bytes() == first


def test_a_broken_picture_is_compared_by_its_bytes(tmp_path: Path) -> None:
    records = [made_up_record(0), made_up_record(1, image=b"broken"), made_up_record(2, image=b"broken")]
    records = [replace(record, sha256="0" * 64) if record.image == b"broken" else record for record in records]
    store = made_up_store(tmp_path / "s", records)
    assert find_duplicates(store).groups() == {"p-00001": 0, "p-00002": 0}
    assert pq.read_table(store.path / "duplicates.parquet")["phash"].null_count == 2


@given(
    st.lists(st.tuples(st.integers(0, 14), st.integers(0, 14)), max_size=25),
    st.lists(st.integers(0, 9), min_size=15, max_size=15),
)
def test_groups_are_those_of_flooding(pairs: list[tuple[int, int]], pictures: list[int]) -> None:
    """`near` pairs join first pictures; patches with one picture are copies."""
    first = {picture: pictures.index(picture) for picture in pictures}
    near = sorted({(min(a, b), max(a, b)) for a, b in pairs if a != b and {a, b} <= set(first.values())})
    found = group_patches(
        [f"p{i}" for i in range(15)], [str(picture) for picture in pictures], np.array(near, np.int64).reshape(-1, 2)
    )
    alike = {*near, *((first[picture], i) for i, picture in enumerate(pictures))}
    groups = flood(15, lambda i, j: (i, j) in alike)
    expected = {f"p{i}": number for number, group in enumerate(groups) for i in group}
    assert found.groups() == expected
    firsts = found.firsts()
    for patch, leader in firsts.items():
        i, j = int(leader[1:]), int(patch[1:])
        assert i < j
        assert leader not in firsts  # a first one repeats nothing
        rank = first[pictures[j]]
        assert i == rank or (min(i, rank), max(i, rank)) in near
    for j in range(15):  # who repeats nothing is not like any first one before
        if f"p{j}" not in firsts:
            assert not any((i, j) in near and f"p{i}" not in firsts for i in range(j))
            assert first[pictures[j]] == j


def test_the_first_that_passes_is_kept() -> None:
    verdicts = [
        Verdict("a", False, "depth_m", ("depth_m",)),
        Verdict("b", True),
        Verdict("c", True),
        Verdict("d", True),
    ]
    judged = list(drop_repeats(verdicts, {"b": "a", "c": "a"}))
    assert [(verdict.reason, verdict.is_kept) for verdict in judged] == [
        ("depth_m", False), ("kept", True), ("duplicate", False), ("kept", True),
    ]  # fmt: skip
    assert [verdict.checks[-1].is_passed for verdict in judged] == [True, True, False, True]


def test_dropping_needs_somebody_who_looked(store: PatchStore) -> None:
    recipe = replace(RECIPE, drop_duplicates=True)
    with pytest.raises(InputError, match="run `carstudio dataset duplicates"):
        judge_store(store, recipe)
    find_duplicates(store)
    judge_store(store, recipe)
    assert open_store(store.path).info()["reasons"] == {"kept": 9, "duplicate": 3}
    judge_store(store, RECIPE)
    assert open_store(store.path).info()["reasons"] == {"kept": 12}


def test_standard_splits_keep_groups_together_but_the_released_one(store: PatchStore) -> None:
    released = store.split("released-patch")
    find_duplicates(store)
    write_standard_splits(open_store(store.path))
    again = open_store(store.path)
    assert again.split("released-patch") == released
    groups = read_duplicates(again).groups()  # type: ignore[union-attr]  # just written
    for name in ("instance", "view"):
        assert not parted(groups, again.split(name))


def parted(groups: dict[str, int], parts: dict[str, str]) -> bool:
    sides = {(groups[patch], part) for patch, part in parts.items() if patch in groups}
    return len(sides) > len({group for group, _ in sides})


VIEWS = st.lists(st.tuples(st.integers(0, 9), st.none() | st.integers(0, 6)), max_size=40)


def views_of(drawn: list[tuple[int, int | None]]) -> list[View]:
    return [View(f"p{i}", f"c{car}", i, f"s{car % 3}", group) for i, (car, group) in enumerate(drawn)]


@given(VIEWS, st.sampled_from(["instance", "view", "sequence", "patch"]), st.integers(0, 3), st.floats(0.05, 0.9))
def test_no_split_parts_a_group_or_a_unit(drawn, by, seed, share) -> None:
    views = views_of(drawn)
    parts = make_split(views, by=by, test_share=share, seed=seed)
    assert parts.keys() == {view.patch_id for view in views}
    assert not parted({view.patch_id: view.duplicates for view in views if view.duplicates is not None}, parts)
    if by in ("instance", "sequence"):
        unit = {view.patch_id: view.instance_id if by == "instance" else view.sequence_id for view in views}
        assert len({(unit[patch], part) for patch, part in parts.items()}) == len(set(unit.values()))


@given(VIEWS)
def test_joined_units_are_those_of_flooding(drawn: list[tuple[int, int | None]]) -> None:
    views = views_of(drawn)
    names = join_units([view.instance_id for view in views], [view.duplicates for view in views])

    def alike(i: int, j: int) -> bool:
        a, b = views[i], views[j]
        return a.instance_id == b.instance_id or (a.duplicates is not None and a.duplicates == b.duplicates)

    groups = flood(len(views), alike)
    expected = [view.instance_id for view in views]
    for group in groups:
        for i in group:
            expected[i] = min(views[k].instance_id for k in group)
    assert names == expected


def test_without_duplicates_nothing_changes() -> None:
    views = [View(f"p{i}", f"c{i // 4}", i) for i in range(100)]
    assert make_split(views, by="instance") == split_by_instance(views)
    assert make_split(views, by="view", test_share=1 / 3) == split_by_view(views)
    shares = Counter(make_split(views, by="patch", test_share=0.25, seed=3).values())
    assert shares == {"train": 75, "test": 25}
    assert make_split(views, by="patch", seed=3) != make_split(views, by="patch", seed=4)


def test_shares_and_sequences_that_cannot_be(store: PatchStore) -> None:
    with pytest.raises(InputError, match="must be above 0 and below 1, found"):
        make_split(kept_views(store), by="patch", test_share=1.0)
    with pytest.raises(InputError, match="12 kept patches belong to no sequence, p-00000 among them"):
        make_split(kept_views(store), by="sequence")


def test_the_verbs(store: PatchStore, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(store.path)
    assert run(["dataset", "refilter", path, "--drop-duplicates"]) == 2
    assert "carstudio dataset duplicates" in capsys.readouterr().err
    assert run(["dataset", "duplicates", path, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["repeating"] == 3
    assert run(["dataset", "split", path, "--name", "mine", "--by", "patch", "--test-share", "0.3", "--json"]) == 0
    parts = open_store(store.path).split("mine")
    groups = read_duplicates(store).groups()  # type: ignore[union-attr]  # just written
    assert len({groups.get(patch, patch) for patch, part in parts.items() if part == "test"}) == 3  # of 9 pictures
    assert json.loads(capsys.readouterr().out)["parts"]["test"] == list(parts.values()).count("test")
    assert run(["dataset", "split", path, "--name", "mine", "--by", "patch"]) == 2
    assert "--force" in capsys.readouterr().err
    assert run(["dataset", "split", path, "--name", "mine", "--by", "patch", "--force"]) == 0
    assert run(["dataset", "split", path, "--name", "../x", "--by", "patch"]) == 2
    assert "split name" in capsys.readouterr().err
