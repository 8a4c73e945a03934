"""Splits: by hand, and by the properties that their names promise."""

from hypothesis import given
from hypothesis import strategies as st

from carstudio.dataset.splits import (
    View,
    make_split,
    seen_from,
    split_as_released,
    split_by_drive,
    split_by_instance,
    split_by_view,
    split_by_yaw,
)


def make_views(counts: list[int]) -> list[View]:
    return [View(f"p-{car}-{k}", f"c-{car}", k) for car, count in enumerate(counts) for k in range(count)]


COUNTS = st.lists(st.integers(1, 8), max_size=30)


@given(COUNTS)
def test_instance_split_shares_no_car(counts: list[int]) -> None:
    views = make_views(counts)
    parts = split_by_instance(views)
    assert parts.keys() == {view.patch_id for view in views}
    sides = {(view.instance_id, parts[view.patch_id]) for view in views}
    assert len(sides) == len(counts)
    tested = [name for name, part in sides if part == "test"]
    assert len(tested) == (0 if len(counts) < 2 else -(-len(counts) // 10))
    assert split_by_instance(views[::-1]) == parts  # order does not matter


def test_instance_split_is_stable_when_cars_are_added() -> None:
    few, many = split_by_instance(make_views([1] * 200)), split_by_instance(make_views([1] * 220))
    moved = [patch for patch in few if few[patch] != many[patch]]
    assert len(moved) <= 4  # 20 of 200 are tested; a random draw would move about 36


def test_view_split_by_hand() -> None:
    views = make_views([1, 2, 3, 4, 7])
    parts = split_by_view(views)
    by_car = ["".join(parts[v.patch_id][1] for v in views if v.instance_id == f"c-{car}") for car in range(5)]
    assert by_car == ["r", "re", "rre", "rree", "rrrreee"]  # "r" for train, "e" for test


def test_yaw_split_by_hand() -> None:
    """Azimuths in time order; the side that is nearest to the first one's trains, also across 180 degrees."""
    degrees = [170.0, 90.0, -170.0, 10.0, -100.0, 150.0]
    views = [View(f"p{i}", "c", i) for i in range(6)] + [View("alone", "d", 0)]
    given_views = seen_from(views, {f"p{i}": angle for i, angle in enumerate(degrees)})
    parts = make_split(given_views, by="yaw", test_share=0.5)
    assert {patch for patch, part in parts.items() if part == "train"} == {"p0", "p2", "p5", "alone"}
    assert split_by_yaw(views, 2 / 3)["p5"] == "test", "without boxes the first views train"


@given(COUNTS, st.randoms())
def test_view_split_goes_by_time_not_by_store_order(counts: list[int], random: object) -> None:
    views = make_views(counts)
    shuffled = list(views)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assert split_by_view(shuffled) == split_by_view(views)


def test_released_split_by_hand() -> None:
    """N = 12: n_train = ceil(10.8) = 11, linspace(0, 11, 11) = 0, 1.1, 2.2, ..., 9.9, 11 -> 10 alone is left out."""
    parts = split_as_released(make_views([12]))
    assert [patch for patch, part in parts.items() if part == "test"] == ["p-0-10"]


@given(st.integers(0, 400))
def test_released_split_in_exact_arithmetic(count: int) -> None:
    views = make_views([1] * count)
    num_train = -(-9 * count // 10)
    # int(i * (N - 1) / (n - 1)) in integers; numpy's linspace may fall one lower where that division is exact
    exact = {i * (count - 1) // (num_train - 1) for i in range(num_train)} if num_train > 1 else {0} if count else set()
    train = {i for i, view in enumerate(views) if split_as_released(views)[view.patch_id] == "train"}
    assert len(train) == num_train
    assert len(train ^ exact) <= 2


def test_drive_split_by_hand() -> None:
    """A drive from 170 over 180 to -160 degrees: 175 and -165 lie within it, the rest of the turn is tested."""
    drive = [View(f"d{i}", "c", i, "c") for i in range(3)]
    turned = [View(f"t{i}", "c", 10 + i) for i in range(5)]
    degrees = {"d0": 170.0, "d1": -175.0, "d2": -160.0, "t0": 175.0, "t1": -165.0, "t2": -159.0, "t3": 169.0, "t4": 0.0}
    parts = split_by_drive(seen_from([*drive, *turned, View("x", "other", 0)], degrees | {"x": 5.0}))
    assert parts == dict.fromkeys(("d0", "d1", "d2"), "train") | dict.fromkeys(("t2", "t3", "t4"), "test")
