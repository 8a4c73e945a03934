"""Detections in place of labels: joined to 3-D boxes, masks of neighbours sorted out."""

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.dataset.known_boxes import Dd3dBoxes, KittiBoxes, make_box_estimator, read_dd3d, upright
from carstudio.dataset.masks import masks_of_frame, moved
from carstudio.dataset.recognition import Perception, join, recognise
from carstudio.dataset.sources.frame import Frame, LabelledObject
from carstudio.errors import InputError
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_y
from carstudio.perception.results import Detection2D, MaskResult, Photo, SegmentRequest, Window

IMAGE = np.zeros((60, 100, 3), np.uint8)
CAMERA = Camera(torch.tensor([100.0, 100.0, 50.0, 30.0], dtype=torch.float64), 100, 60)


def frame_of(*objects: LabelledObject, **more: object) -> Frame:
    values: dict[str, object] = {
        "frame_id": "a",
        "image_path": "a.png",
        "image": b"",
        "intrinsics": (100.0, 100.0, 50.0, 30.0),
        "camera_source": "given",
        "objects": objects,
        "patch_prefix": "ph-a",
    }
    return Frame(**(values | more))  # type: ignore[arg-type]  # by name


def thing(name: str, box: tuple[float, float, float, float], depth: float | None = None) -> LabelledObject:
    plain = LabelledObject(patch_id=name, instance_id=name, type="Car", box2d=box)
    if depth is None:
        return plain
    return replace(plain, box_center=(0.0, 0.0, depth), box_size=(4.0, 1.5, 1.8), box_yaw=0.3)


def slow_iou(a: Sequence[float], b: Sequence[float]) -> float:
    cells = [
        {(x, y) for x in range(int(box[0]), int(box[2])) for y in range(int(box[1]), int(box[3]))} for box in (a, b)
    ]
    return len(cells[0] & cells[1]) / len(cells[0] | cells[1])


def test_joining_takes_best_overlaps_first_and_each_box_once() -> None:
    rng = np.random.default_rng(0)
    for _ in range(40):

        def boxes(n: int) -> list[tuple[float, ...]]:
            corner, size = rng.integers(0, 6, (n, 2)), rng.integers(4, 10, (n, 2))
            return [tuple(map(float, row)) for row in np.concatenate([corner, corner + size], axis=1)]

        ours, theirs = boxes(4), boxes(3)
        pairs = sorted(itertools.product(range(4), range(3)), key=lambda p: (-slow_iou(ours[p[0]], theirs[p[1]]), p))
        expected: dict[int, int] = {}
        for i, j in pairs:
            if slow_iou(ours[i], theirs[j]) >= 0.5 and i not in expected and j not in expected.values():
                expected[i] = j
        assert join(ours, theirs) == expected
    assert join([], boxes(2)) == join(boxes(2), []) == {}


@dataclass(frozen=True)
class Fixed:
    """The same boxes in every photograph."""

    boxes: tuple[Detection2D, ...]

    def detect(self, photos: Sequence[Photo]) -> list[list[Detection2D]]:
        return [list(self.boxes) for _ in photos]


@dataclass(frozen=True)
class Whole:
    """Every pixel of the window is car."""

    def segment(self, request: SegmentRequest) -> MaskResult:
        shape = (request.window.height, request.window.width)
        return MaskResult(np.ones(shape, bool), np.zeros(shape, bool), 0.9)


NEAR = Detection2D((10.0, 10.0, 50.0, 50.0), "Car", 0.9)
FAR = Detection2D((40.0, 15.0, 80.0, 40.0), "Truck", 0.8)


def test_detections_take_the_labels_boxes_and_keep_their_own_scores() -> None:
    label = replace(thing("km-1", (12.0, 10.0, 50.0, 52.0), 9.0), score_3d=0.7, occlusion=2)
    perception = Perception(segmenter=Whole(), detector=Fixed((NEAR, FAR)))
    (seen,) = recognise([frame_of(label)], [IMAGE], perception)
    near, far = seen.objects
    assert (near.patch_id, near.instance_id, near.type) == ("ph-a-000", "ph-a-000", "Car")
    assert (near.box2d, near.score_2d, near.score_3d) == (NEAR.box2d, 0.9, 0.7)
    assert (near.box_center, near.box_size, near.box_yaw) == (label.box_center, label.box_size, label.box_yaw)
    assert near.occlusion is None  # the label's, not the detection's
    assert (far.type, far.box_center, far.box_size, far.box_yaw) == ("Truck", None, None, None)
    (seen,) = recognise([frame_of(label)], [IMAGE], replace(perception, uses_label_boxes=False))
    assert seen.objects[0].box_center is None
    (seen,) = recognise([frame_of(label)], [IMAGE], Perception(segmenter=Whole(), uses_label_boxes=False))
    assert (seen.objects[0].patch_id, seen.objects[0].box_center) == ("km-1", None)


def test_the_largest_detection_is_the_adverts_car() -> None:
    frame = frame_of(instance_id="dv-7", extra={"year": "2017"})
    (seen,) = recognise([frame], [IMAGE], Perception(segmenter=Whole(), detector=Fixed((FAR, NEAR))))
    assert [one.instance_id for one in seen.objects] == ["ph-a-000", "dv-7"]
    assert seen.objects[1].extra == {"type": "Car", "year": "2017"}


def test_a_photograph_whose_boxes_cannot_be_read_keeps_its_patches(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("Car 0 0\n")
    perception = Perception(segmenter=Whole(), detector=Fixed((NEAR,)), boxes=KittiBoxes(tmp_path))
    (seen,) = recognise([frame_of()], [IMAGE], perception)
    assert seen.objects[0].box_center is None
    assert seen.problems[0].startswith("frame a has no 3-D boxes: a.txt line 1: expected 15 columns")


def test_kitti_boxes_are_carried_into_the_camera(tmp_path: Path) -> None:
    line = "Car -1 -1 0 12 10 50 52 1.5 1.8 4.2 1 2 9 0.3"
    (tmp_path / "a.txt").write_text(f"{line} 0.75\nPedestrian 0 0 0 1 1 9 9 1 1 1 0 0 5 0 0.5\n")
    photo = Photo(
        image=IMAGE, frame_id="a", path="a.png", intrinsics=(1.0, 1.0, 0.0, 0.0), camera_offset=(0.06, 0.0, 0.003)
    )
    car, person = KittiBoxes(tmp_path).estimate(photo)
    assert car.center == pytest.approx((1.06, 2 - 0.75, 9.003))
    assert (car.size, car.yaw, car.score, car.type) == ((4.2, 1.5, 1.8), 0.3, 0.75, "Car")
    assert person.type == "Pedestrian"
    (tmp_path / "a.txt").write_text(f"{line} 7.5\n")
    with pytest.raises(InputError, match=r"a\.txt: scores must lie between 0 and 1, found 7\.5"):
        KittiBoxes(tmp_path).estimate(photo)
    assert KittiBoxes(tmp_path).estimate(replace(photo, frame_id="b", path="b.png")) == []


def turn(axis: int, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    rows = {0: [[1, 0, 0], [0, c, -s], [0, s, c]], 2: [[c, -s, 0], [s, c, 0], [0, 0, 1]]}
    return np.array(rows[axis])


def dd3d_record(rotation: np.ndarray, **more: object) -> dict[str, object]:
    quaternion = quaternion_from_rotation(torch.tensor(rotation)).tolist()
    record = {
        "category_id": 0,
        "category": "Car",
        "bbox3d": [*quaternion, 1.0, 2.0, 9.0, 1.8, 4.2, 1.5],
        "bbox": [12.0, 10.0, 38.0, 42.0],
        "score": 0.9,
        "score_3d": 0.7,
        "file_name": "/data/kitti/image_2/000007.png",
        "image_id": "000007",
    }
    return record | more


@pytest.mark.parametrize("yaw", [-3.0, -1.2, 0.0, 0.4, 2.7])
def test_dd3ds_axes_become_ours(tmp_path: Path, yaw: float) -> None:
    """DD3D's upright car: its up axis along the camera's -y, turned by minus KITTI's yaw about it."""
    file = tmp_path / "bbox3d_predictions.json"
    file.write_text(json.dumps([dd3d_record(turn(0, math.pi / 2) @ turn(2, -yaw))]))
    read_dd3d.cache_clear()
    photo = Photo(image=IMAGE, frame_id="000007", path="x/000007.png", intrinsics=(1.0, 1.0, 0.0, 0.0))
    (box,) = Dd3dBoxes(file).estimate(photo)
    assert box.yaw == pytest.approx(yaw, abs=1e-6)
    assert (box.rotation, box.center, box.size) == (None, (1.0, 2.0, 9.0), (4.2, 1.5, 1.8))
    assert (box.box2d, box.score, box.type) == ((12.0, 10.0, 50.0, 52.0), 0.7, "Car")


def test_a_leaning_box_keeps_its_rotation() -> None:
    leaning = torch.tensor(turn(0, 0.1)) @ rotation_y(torch.tensor(0.5, dtype=torch.float64))
    yaw, quaternion = upright(leaning)
    assert quaternion is not None
    assert yaw == pytest.approx(0.5, abs=0.01)
    assert upright(rotation_y(torch.tensor(0.5, dtype=torch.float64))) == (pytest.approx(0.5), None)


BROKEN_DD3D = {
    "expected a list of DD3D's predictions": {},
    "[0]: expected category, bbox3d": [3],
    "[0]: bbox3d must have 10 numbers": [dd3d_record(np.eye(3), bbox3d=[1.0])],
    "[0]: expected a unit quaternion and positive sizes": [dd3d_record(np.eye(3), bbox3d=[0.0] * 10)],
    "[0]: score_3d must lie between 0 and 1": [dd3d_record(np.eye(3), score_3d=3.0)],
}


@pytest.mark.parametrize(("message", "content"), BROKEN_DD3D.items())
def test_malformed_predictions_are_named(tmp_path: Path, message: str, content: object) -> None:
    file = tmp_path / "p.json"
    file.write_text(json.dumps(content))
    read_dd3d.cache_clear()
    with pytest.raises(InputError) as caught:
        make_box_estimator(f"precomputed:{file}")
    assert message in str(caught.value)


def test_specs_of_boxes(tmp_path: Path) -> None:
    assert make_box_estimator("none") is None
    assert make_box_estimator(f"precomputed:{tmp_path}") == KittiBoxes(tmp_path)
    for spec, message in {
        "guess": "expected one of labels, none",
        "precomputed:absent": "no folder of KITTI text",
    }.items():
        with pytest.raises(InputError, match=message):
            make_box_estimator(spec)


def test_pixels_of_a_nearer_vehicle_are_unknown_and_shared_ones_belong_to_nobody() -> None:
    """Without 3-D boxes the one that reaches lower is nearer. Whole boxes as masks: all that overlaps is shared."""
    near, far = thing("near", NEAR.box2d), replace(thing("far", FAR.box2d), type="Truck")
    frame = frame_of(near, far)
    of_near, of_far = masks_of_frame(frame, IMAGE, CAMERA, [near, far], Whole())
    assert isinstance(of_near, MaskResult)
    assert isinstance(of_far, MaskResult)
    shared = np.zeros((60, 100), bool)
    shared[15:41, 40:51] = True  # as released, a crop has the column and row of its box's far edges too
    np.testing.assert_array_equal(of_near.unknown, shared[10:51, 10:51])
    np.testing.assert_array_equal(of_far.unknown, shared[15:41, 40:81])
    for result in (of_near, of_far):
        assert not (result.car & result.unknown).any()
        assert (result.car | result.unknown).all()
    (alone,) = masks_of_frame(frame, IMAGE, CAMERA, [near], Whole())  # what is not wanted is sorted out all the same
    assert isinstance(alone, MaskResult)
    np.testing.assert_array_equal(alone.unknown, of_near.unknown)


@dataclass(frozen=True)
class Half:
    """The left half of the window is car."""

    def segment(self, request: SegmentRequest) -> MaskResult:
        car = np.zeros((request.window.height, request.window.width), bool)
        car[:, : car.shape[1] // 2] = True
        return MaskResult(car, np.zeros_like(car), 0.9)


def test_background_of_the_nearer_stays_background() -> None:
    """The farther car's pixels say nothing about the nearer one; the nearer one's hide the farther."""
    near, far = thing("near", (10.0, 10.0, 49.0, 50.0)), thing("far", (0.0, 15.0, 39.0, 40.0))
    of_near, of_far = masks_of_frame(frame_of(near, far), IMAGE, CAMERA, [near, far], Half())
    assert isinstance(of_near, MaskResult)
    assert isinstance(of_far, MaskResult)
    both = of_near.unknown
    assert both[5:31, :10].all()
    assert both.sum() == 26 * 10  # columns 10 to 19, where the far car's half and the near car's overlap
    assert of_far.unknown[:, 10:30].all()
    assert of_far.unknown.sum() == 26 * 20
    deep = [thing("near", near.box2d, 9.0), thing("far", far.box2d, 5.0)]
    of_near, of_far = masks_of_frame(frame_of(*deep), IMAGE, CAMERA, deep, Half())
    assert isinstance(of_far, MaskResult)
    assert not of_far.unknown.any()  # with 3-D boxes outlines tell, and the segmenter has them


def test_an_object_that_cannot_be_segmented_costs_only_itself() -> None:
    outside = thing("outside", (200.0, 10.0, 300.0, 50.0))
    good = thing("good", NEAR.box2d)
    first, second = masks_of_frame(frame_of(outside, good), IMAGE, CAMERA, [outside, good], Whole())
    assert isinstance(first, InputError)
    assert isinstance(second, MaskResult)


def test_masks_move_between_windows() -> None:
    rng = np.random.default_rng(0)
    whole = rng.random((30, 40)) < 0.5
    one, other = Window(5, 4, 20, 12), Window(12, 1, 25, 20)
    expected = np.zeros_like(whole)
    expected[one.slices] = whole[one.slices]
    np.testing.assert_array_equal(moved(whole[one.slices], one, other), expected[other.slices])
