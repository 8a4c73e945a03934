"""The whole adapter on real frames: were the network perfect, a build with DD3D would store the labels' boxes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.dataset.recognition import Perception, recognise
from carstudio.dataset.sources.kitti_det import open_kitti_det
from carstudio.dataset.sources.kitti_format import parse_labels
from carstudio.geometry.camera import Camera
from carstudio.images import decode_image
from carstudio.perception.dd3d import adapter
from carstudio.perception.dd3d.adapter import SHORTEST_PX, Dd3dEstimator
from carstudio.perception.dd3d.decoding import Detections, Selection, candidates
from carstudio.perception.dd3d.model import KITTI_CLASSES
from carstudio.perception.dd3d.nms import Suppression, settled
from carstudio.perception.grabcut import GrabCutSegmenter
from oracles import dd3d_slow as slow
from perception.dd3d_encoding import CANONICAL, Said, say, silent_outputs

STRIDE = 8


@dataclass(frozen=True)
class Perfect:
    """Says what a frame's labels say, in the frame of the labels, as the network has learned it."""

    labels: Path
    width: int  # px of the photo
    height: int

    def detect(self, images: list[torch.Tensor], cameras: list[Camera]) -> list[Detections]:
        (image,), (camera,) = images, cameras
        rows, columns = image.shape[1] // STRIDE, image.shape[2] // STRIDE
        outputs = silent_outputs(rows, columns)
        factor = np.array([camera.width / self.width, camera.height / self.height] * 2)
        names = list(KITTI_CLASSES)
        taken: set[tuple[int, int]] = set()
        for label in parse_labels(self.labels.read_text(), name="labels"):
            if label.type not in names or label.size is None or label.bottom_center is None:
                continue
            center = np.array(label.bottom_center) - [0, label.size[1] / 2, 0]
            sides = np.array(label.box2d) * factor
            place = (int((sides[1] + sides[3]) / 2 // STRIDE), int((sides[0] + sides[2]) / 2 // STRIDE))
            while place in taken:
                place = (place[0], place[1] + 1)
            taken.add(place)
            rotation = slow.kitti_object_rotation(label.yaw_rad)
            said = Said(names.index(label.type), rotation, center, label.size, tuple(sides.tolist()))
            say(outputs, STRIDE, camera.intrinsics.tolist(), said, place)
        batch = Camera(camera.intrinsics[None].float(), camera.width, camera.height)
        (found,) = candidates([outputs], [STRIDE], batch, torch.tensor(CANONICAL), Selection())
        return [settled(found, Suppression())]


def test_a_perfect_network_gives_the_labels(test_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_kitti_det(test_data / "kitti-obj")
    compared = 0
    for ref in source.frames():
        frame = source.load(ref)
        pixels = decode_image(frame.image, name=frame.image_path)
        height, width = pixels.shape[:2]
        assert height < SHORTEST_PX  # the photo is enlarged, and not equally in x and y: both are rounded
        perfect = Perfect(source.folder / "label_2" / f"{ref.stem}.txt", width, height)
        monkeypatch.setattr(adapter, "open_dd3d", lambda *_, perfect=perfect: perfect)
        perception = Perception(
            GrabCutSegmenter(), boxes=Dd3dEstimator(folder=Path("none"), device="cpu"), uses_label_boxes=False
        )
        (seen,) = recognise([frame], [pixels], perception)
        for found, label in zip(seen.objects, frame.objects, strict=True):
            if label.type not in ("Car", "Van", "Truck"):
                continue
            assert found.box_center == pytest.approx(label.box_center, abs=2e-3), (ref.stem, label.extra)
            assert found.box_size == pytest.approx(label.box_size, rel=1e-4)
            assert np.cos(found.box_yaw - label.box_yaw) == pytest.approx(1, abs=1e-5)
            assert found.score_3d > 0.99
            compared += 1
    assert compared == 30  # every vehicle of the eleven frames
