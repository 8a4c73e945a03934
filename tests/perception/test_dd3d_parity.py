"""DD3D equals the original: features, raw outputs, candidates and boxes, with weights made by a recipe.

One test per backbone, since building its weights and one pass through V2-99 take ten seconds of a core.
"""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_from_quaternion
from carstudio.perception.dd3d.adapter import as_seen, to_photo
from carstudio.perception.dd3d.decoding import Detections, candidates
from carstudio.perception.dd3d.heads import HeadOutputs
from carstudio.perception.dd3d.kitti import alpha, bottom_center, rotation_y
from carstudio.perception.dd3d.model import DD3D, KITTI_CLASSES, Backbone, DD3DConfig
from carstudio.perception.dd3d.nms import Suppression, from_above, settled
from carstudio.perception.results import Photo
from perception.dd3d_reference import Reference, real_reference, recipe_weights, synthetic_input

# What the original itself differs by with another convolution backend (README.md of the reference); "stats": means and
# deviations per channel, which a constant error would move.
FEATURES = 4e-4
RAW = {
    "logits": ("logits", 1.1e-3),
    "centerness": ("centerness", 5e-4),
    "box2d_reg": ("box2d", 1.3e-2),
    "quat": ("quaternion", 6e-4),
    "ctr": ("center", 1.8e-2),
    "depth": ("depth", 2.4e-3),
    "size": ("size", 3e-4),
    "conf": ("confidence", 5e-4),
}
BOXES = {
    "scores": ("score_2d", 7e-5),
    "scores_3d": ("score_3d", 7e-5),
    "quat": ("quaternion", 2e-4),
    "proj_ctr": ("projected_center", 1.8e-2),
    "tvec": ("center", 1e-3),
    "size": ("size", 7e-4),
}
CHOICES = {"levels": "level", "loc_index": "cell", "classes": "kind"}
EVERYTHING = Suppression(most_boxes=1_000_000)


@pytest.fixture
def threads_of_the_reference() -> Iterator[None]:
    """Four, as the original ran with: one thread sums convolutions in another order (100 times the difference)."""
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads_of_the_reference")
@pytest.mark.parametrize("backbone", ["dla34", "v2-99"])
@torch.inference_mode()
def test_it_equals_the_original(dd3d_data: Path, backbone: Backbone) -> None:
    network = DD3D(DD3DConfig(backbone)).eval()
    weights = recipe_weights(dd3d_data, backbone, network.state_dict())
    assert list(network.state_dict()) == list(weights)
    network.load_state_dict(weights)
    reference = real_reference(dd3d_data, backbone)
    check_input(network, reference)
    check_features_and_boxes(network, reference, factor=1)
    plain = check_second_input(network)
    network.fuse()
    check_features_and_boxes(network, reference, factor=10)
    (fused,) = network.detect(*([part] for part in synthetic_input()))
    assert sorted(choices(fused)) == sorted(choices(plain))
    np.testing.assert_allclose(fused.score_3d, plain.score_3d, atol=7e-4)
    if backbone == "dla34":
        check_low_precision(network)


def check_input(network: DD3D, reference: Reference) -> None:
    expected = reference.arrays
    pixels = network.prepare([reference.image])
    assert list(pixels.shape) == expected["pre_shape"].tolist()
    assert_stats(pixels, expected, "pre", 1e-6)
    np.testing.assert_allclose(pixels[0, :, :6, :8], expected["pre_slice_tl"], atol=1e-6)
    np.testing.assert_allclose(pixels[0, :, -4:, -24:], expected["pre_slice_br"], atol=1e-6)
    assert (pixels[0, :, -4:, -8:] == 0).all()  # padding on the right


def check_features_and_boxes(network: DD3D, reference: Reference, factor: float) -> None:
    pixels = network.prepare([reference.image])
    features: dict[str, Tensor] = {}
    hooks = [
        module.register_forward_hook(lambda _, __, out, name=name: features.update({name: out}))
        for name, module in network.backbone.bottom_up.named_children()
    ]
    levels: list[Tensor] = []
    hooks.append(network.backbone.register_forward_hook(lambda _, __, out: levels.extend(out)))
    outputs = network(pixels)
    for hook in hooks:
        hook.remove()
    expected = reference.arrays
    for name, feature in features.items():
        assert list(feature.shape) == expected[f"bottomup_{name}_shape"].tolist()
        assert_stats(feature, expected, f"bottomup_{name}", FEATURES * factor)
    first = int(np.log2(network.backbone.strides[0]))
    for name, feature in ((f"fpn_p{first + i}", level) for i, level in enumerate(levels)):
        assert list(feature.shape) == expected[f"{name}_shape"].tolist()
        assert_stats(feature, expected, name, FEATURES * factor)
        rows, columns = feature.shape[-2:]
        places = [(0, 0), (0, -1), (-1, 0), (-1, -1), (rows // 2, columns // 2), (rows // 3, columns // 4)]
        found = torch.stack([feature[0, :, row, column] for row, column in places])
        np.testing.assert_allclose(found, expected[f"{name}_loc"], atol=FEATURES * factor, rtol=0)
        (whole,) = [key for key in expected if key.startswith(f"{name}_ch_")]
        step = int(whole.rpartition("_s")[2])
        np.testing.assert_allclose(
            feature[0, [0, 17, 128, 255], ::step, ::step], expected[whole], atol=FEATURES * factor, rtol=0
        )
    check_outputs(outputs, expected, factor)
    check_boxes(network, outputs, pixels, reference, factor)


def assert_stats(feature: Tensor, expected: Mapping[str, np.ndarray], name: str, tolerance: float) -> None:
    """Mean and population deviation over space."""
    std, mean = torch.std_mean(feature[0].flatten(1).double(), dim=1, correction=0)
    np.testing.assert_allclose(torch.stack([mean, std]), expected[f"{name}_stats"], atol=tolerance, rtol=0)


def check_outputs(outputs: list[HeadOutputs], expected: Mapping[str, np.ndarray], factor: float) -> None:
    assert len(outputs) == 5
    for level, output in enumerate(outputs):
        for theirs, (ours, tolerance) in RAW.items():
            name, value = f"raw_{theirs}_{level}", getattr(output, ours)
            assert_stats(value, expected, name, tolerance * factor)
            step = 1 if name in expected else 4
            whole = expected[name if step == 1 else f"{name}_s4"]
            np.testing.assert_allclose(value[0, :, ::step, ::step], whole, atol=tolerance * factor, rtol=0)


def check_boxes(network: DD3D, outputs: list[HeadOutputs], pixels: Tensor, reference: Reference, factor: float) -> None:
    expected, camera = reference.arrays, reference.camera
    batch = Camera(camera.intrinsics[None].float(), pixels.shape[-1], pixels.shape[-2])
    strides, selection = network.backbone.strides, network.config.selection
    (found,) = candidates(outputs, strides, batch, network.canonical_sizes, selection)
    assert_boxes(found, expected, "cand", factor)
    np.testing.assert_allclose(found.box2d, expected["cand_boxes2d"], atol=1.3e-2 * factor, rtol=0)
    left = settled(found, EVERYTHING)
    ours = sorted(zip(left.level.tolist(), left.cell.tolist(), left.kind.tolist(), strict=True))
    theirs = zip(*(expected[f"nms_{name}"].tolist() for name in CHOICES), strict=True)
    assert ours == list(theirs)
    final = settled(found, network.config.suppression)
    assert_boxes(final, expected, "det", factor)
    np.testing.assert_allclose(final.box2d, expected["det_boxes2d_resized"], atol=1.2e-2 * factor, rtol=0)
    check_in_other_forms(final, camera, expected, factor)


def assert_boxes(found: Detections, expected: Mapping[str, np.ndarray], prefix: str, factor: float) -> None:
    for theirs, ours in CHOICES.items():  # the same ones, in the same order
        np.testing.assert_array_equal(getattr(found, ours), expected[f"{prefix}_{theirs}"])
    for theirs, (ours, tolerance) in BOXES.items():
        value, whole = getattr(found, ours).numpy(), expected[f"{prefix}_{theirs}"]
        if ours == "quaternion":  # q and -q are one rotation; w near 0 may take either sign
            whole = whole * np.sign((value * whole).sum(axis=1, keepdims=True))
        np.testing.assert_allclose(value, whole, atol=tolerance * factor, rtol=0, err_msg=f"{prefix} {theirs}")


def check_in_other_forms(final: Detections, seen: Camera, expected: Mapping[str, np.ndarray], factor: float) -> None:
    """Boxes of the photo, corners, KITTI's columns, rectangles from above."""
    image = np.zeros((375, 1242, 3), np.uint8)
    photo = Photo(image=image, frame_id="000008", path="000008.png", intrinsics=(1.0, 1.0, 0.0, 0.0))
    vehicles = np.isin(expected["det_classes"], [list(KITTI_CLASSES).index(name) for name in ("Car", "Van", "Truck")])
    boxes = to_photo(final, seen, photo)
    np.testing.assert_allclose(
        [box.box2d for box in boxes], expected["det_boxes2d"][vehicles], atol=1.2e-2 * factor, rtol=0
    )
    signs = np.array([(x, y, z) for x, pairs in ((1, "++ -+ -- +-"), (-1, "++ -+ -- +-")) for y, z in _pairs(pairs)])
    offsets = signs * final.size.numpy()[:, None, [1, 0, 2]] / 2
    corners = offsets @ rotation_from_quaternion(final.quaternion).mT.numpy() + final.center.numpy()[:, None]
    theirs, tolerance = expected["det_corners"], 2e-3 * factor
    distance = np.linalg.norm(corners[:, :, None] - theirs[:, None], axis=-1)  # as sets: the order is not ours
    assert distance.min(axis=2).max() < tolerance
    assert distance.min(axis=1).max() < tolerance
    kitti = expected["det_kitti_WLHxyz_ry_alpha"]
    np.testing.assert_allclose(bottom_center(final), kitti[:, 3:6], atol=2e-3 * factor, rtol=0)
    assert np.abs(np.sin((rotation_y(final).numpy() - kitti[:, 6]) / 2)).max() < 1e-3 * factor
    assert np.abs(np.sin((alpha(final).numpy() - kitti[:, 7]) / 2)).max() < 5.1e-3 + 1e-3 * factor  # a rounding step
    from_their_numbers = expected["det_bev_xywla_deg"]
    rectangles = from_above(final).numpy()
    np.testing.assert_allclose(rectangles.mean(axis=1)[:, 0], from_their_numbers[:, 0], atol=2e-3 * factor)
    np.testing.assert_allclose(rectangles.mean(axis=1)[:, 1], -from_their_numbers[:, 1], atol=2e-3 * factor)
    width = np.linalg.norm(rectangles[:, 0] - rectangles[:, 1], axis=1)
    length = np.linalg.norm(rectangles[:, 1] - rectangles[:, 2], axis=1)
    np.testing.assert_allclose(np.stack([width, length], axis=1), from_their_numbers[:, 2:4], atol=2e-3 * factor)


def _pairs(text: str) -> list[tuple[int, int]]:
    return [(1 if y == "+" else -1, 1 if z == "+" else -1) for y, z in text.split()]


def check_second_input(network: DD3D) -> Detections:
    """Another size, another camera: sound outputs, and two photos together as each alone."""
    image, camera = synthetic_input()
    images, cameras = [image, image.flip(-1)], [camera, camera.flip()]
    assert network.prepare(images).shape == (2, 3, 128, 256)  # no padding
    together = network(network.prepare(images))
    alone = network(network.prepare([image]))
    for stride, one, both in zip(network.backbone.strides, alone, together, strict=True):
        assert one.logits.shape == (1, 5, 128 // stride, 256 // stride)
        for theirs, (ours, tolerance) in RAW.items():
            value = getattr(one, ours)[0]
            assert value.isfinite().all()
            np.testing.assert_allclose(value, getattr(both, ours)[0], atol=tolerance, rtol=0, err_msg=theirs)
    (found,), both = boxes_of(network, alone, [camera]), boxes_of(network, together, cameras)
    assert choices(found) == choices(both[0]) != choices(both[1])
    for boxes in (found, *both):
        assert len(boxes) == 100  # what the reference's notes say of this input
        assert all(getattr(boxes, field.name).isfinite().all() for field in fields(boxes))
        assert float(boxes.center[:, 2].min()) >= 0.1 - 1e-6
    return found


def check_low_precision(network: DD3D) -> None:
    """bfloat16 rounds to 8 bits at each of dozens of layers; random weights make the most of that."""
    pixels = network.prepare([synthetic_input()[0]])
    exact, rough = network(pixels), network.set_precision(torch.bfloat16)(pixels)
    for field in fields(HeadOutputs):
        one, two = (getattr(outputs[0], field.name).flatten() for outputs in (exact, rough))
        assert two.dtype == torch.float32
        assert float(torch.corrcoef(torch.stack([one, two]))[0, 1]) > 0.9, field.name


def boxes_of(network: DD3D, outputs: list[HeadOutputs], cameras: list[Camera]) -> list[Detections]:
    camera = Camera(torch.stack([camera.intrinsics for camera in cameras]), 256, 128)
    found = candidates(outputs, network.backbone.strides, camera, network.canonical_sizes, network.config.selection)
    return [settled(boxes, network.config.suppression) for boxes in found]


def choices(found: Detections) -> list[tuple[int, int, int]]:
    """Level, cell and class of each box, in order."""
    return list(zip(found.level.tolist(), found.cell.tolist(), found.kind.tolist(), strict=True))


def test_the_photo_is_resized_as_the_original_does(dd3d_data: Path, test_data: Path) -> None:
    from carstudio.images import read_image

    reference = real_reference(dd3d_data, "dla34")
    rgb = read_image(test_data / "kitti-obj" / "training" / "image_2" / "000008.png")
    k = reference.arrays["K_original"]
    camera = Camera(torch.tensor([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]), rgb.shape[1], rgb.shape[0])
    pixels, seen = as_seen(rgb, camera)
    assert torch.equal(pixels, reference.image)
    np.testing.assert_allclose(seen.intrinsics, reference.camera.intrinsics, rtol=1e-6)
    assert (seen.width, seen.height) == (1272, 384)
