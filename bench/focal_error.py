"""What a wrong focal length does to DD3D's 3-D boxes, on the geometry of KITTI's labels.

Usage: python bench/focal_error.py --root KITTI/object [--plot docs/images/dd3d-focal-error.png]

The network looks at pixels alone: where a box's centre is in the image, a depth for a reference camera, a rotation as
seen along the line of sight, a size. The camera comes in afterwards, in the decoding. So the error can be computed:
each labelled box is turned into what a perfect network says of it, and decoded with another focal length; the principal
point is kept, or put in the photo's middle as the paper does. Nothing here depends on weights.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from carstudio.dataset.sources.kitti_det import open_kitti_det
from carstudio.files import write_bytes
from carstudio.geometry.box3d import Box3D, envelope
from carstudio.geometry.camera import Camera
from carstudio.geometry.overlap import box2d_iou
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_y
from carstudio.images import decode_image
from carstudio.perception.dd3d.adapter import DD3D_FROM_CAR
from carstudio.perception.dd3d.decoding import egocentric_from_allocentric, metric_depth, place_in_space
from carstudio.report.plots import AMBER, BLUE, INK, TEAL, dress, figure_bytes

VEHICLES = ("Car", "Van", "Truck")
NEAR_M, FAR_M = 15.0, 30.0  # borders of the three groups
GRID = (24, 10, 12)  # samples of a box along length, height, width
ERRORS = tuple(percent / 100 for percent in range(-30, 31))
SHOWN = (-0.3, -0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.3)  # in the table


@dataclass(frozen=True)
class Analysis:
    """Where the labels are and where the plot goes."""

    root: Path
    plot: Path | None = None


@dataclass(frozen=True)
class Labelled:
    """Upright labelled boxes (camera frame) of one photo, with its camera."""

    box: Box3D
    camera: Camera


@dataclass(frozen=True)
class Measured:
    """One number per box."""

    depth_m: Tensor  # of the label
    center_error_m: Tensor
    depth_error: Tensor  # relative
    yaw_error_deg: Tensor
    box_iou: Tensor  # of the 3-D boxes
    size_iou: Tensor  # of their sizes alone
    envelope_iou: Tensor  # the paper's filter 1: the decoded box in the wrong camera against the true outline
    envelope_iou_of_label: Tensor  # the same for a box that is right (a LiDAR's, say) in the wrong camera


def read_labels(root: Path) -> list[Labelled]:
    """All vehicles of all frames."""
    source = open_kitti_det(root)
    found = []
    for frame in map(source.load, source.frames()):
        things = [thing for thing in frame.objects if thing.type in VEHICLES and thing.box_center and thing.box_size]
        if things:
            height, width = decode_image(frame.image, name=frame.image_path).shape[:2]
            centers, sizes = (
                torch.tensor([getattr(thing, name) for thing in things], dtype=torch.float64)
                for name in ("box_center", "box_size")
            )
            yaws = torch.tensor([thing.box_yaw for thing in things], dtype=torch.float64)
            camera = Camera(torch.tensor(frame.intrinsics, dtype=torch.float64), width, height)
            found.append(Labelled(Box3D(centers, sizes, rotation_y(yaws)), camera))
    return found


def decoded_with(labelled: Labelled, camera: Camera) -> Box3D:
    """The box that a perfect DD3D gives when it is told `camera` in place of the photo's own."""
    box, own = labelled.box, labelled.camera
    object_from_car = torch.tensor(DD3D_FROM_CAR, dtype=torch.float64)
    projected = own.project(box.center)
    ray = own.unproject(projected, torch.ones_like(box.center[:, 0]))
    allocentric = egocentric_from_allocentric(ray).mT @ box.rotation @ object_from_car.mT
    quaternion, depth = quaternion_from_rotation(allocentric), reference_depth(box, own)
    rotation, center = place_in_space(quaternion, depth, projected, camera)
    return Box3D(center, box.size, rotation @ object_from_car)


def reference_depth(box: Box3D, camera: Camera) -> Tensor:
    """The depth that the network must say, so that decoding gives the box's own; `metric_depth` is linear in it."""
    unit = metric_depth(torch.full((1,), 10.0, dtype=torch.float64), camera) / 10.0
    return box.center[:, 2] / unit


def sampled_iou(one: Box3D, other: Box3D) -> Tensor:
    """Of boxes with equal sizes in pairs, by samples of the first: a share s in the other is an IoU of s / (2 - s)."""
    axes = [(torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5 for count in GRID]
    cells = torch.cartesian_prod(*axes)
    points = (cells * one.size[:, None]) @ one.rotation.mT + one.center[:, None]
    inside = ((points - other.center[:, None]) @ other.rotation).abs() <= other.size[:, None] / 2
    share = inside.all(dim=-1).double().mean(dim=-1)
    return share / (2 - share)


def outlines(box: Box3D, camera: Camera) -> Tensor:
    """Envelopes in the image; zeros where nothing is in view."""
    boxes = [Box3D(*(value[i] for value in vars(box).values())) for i in range(len(box.center))]
    found = [envelope(one, camera) for one in boxes]
    return torch.stack([torch.zeros(4).double() if outline is None else outline for outline in found])


def measure(labels: list[Labelled], focal_error: float, *, centred: bool = False) -> Measured:
    """Errors of all boxes with focal lengths wrong by this share; `centred`: and the principal point in the middle."""
    parts = []
    for labelled in labels:
        own, box = labelled.camera, labelled.box
        factors = torch.tensor([1 + focal_error, 1 + focal_error, 1, 1], dtype=torch.float64)
        intrinsics = own.intrinsics * factors
        if centred:
            intrinsics = torch.cat([intrinsics[:2], torch.tensor([own.width / 2, own.height / 2]).double()])
        wrong = Camera(intrinsics, own.width, own.height)
        found = decoded_with(labelled, wrong)
        turned = torch.remainder(found.yaw_rad - box.yaw_rad + torch.pi, 2 * torch.pi) - torch.pi
        smaller, larger = torch.minimum(found.size, box.size).prod(-1), torch.maximum(found.size, box.size).prod(-1)
        true = outlines(box, own)
        parts.append(
            Measured(
                depth_m=box.center[:, 2],
                center_error_m=(found.center - box.center).norm(dim=-1),
                depth_error=found.center[:, 2] / box.center[:, 2] - 1,
                yaw_error_deg=turned.abs().rad2deg(),
                box_iou=sampled_iou(box, found),
                size_iou=smaller / larger,
                envelope_iou=box2d_iou(outlines(found, wrong), true),
                envelope_iou_of_label=box2d_iou(outlines(box, wrong), true),
            )
        )
    return Measured(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def groups(found: Measured) -> dict[str, Tensor]:
    """Which boxes are near, in between and far."""
    z = found.depth_m
    return {
        f"up to {NEAR_M:.0f} m": z <= NEAR_M,
        f"{NEAR_M:.0f} to {FAR_M:.0f} m": (z > NEAR_M) & (z <= FAR_M),
        f"over {FAR_M:.0f} m": z > FAR_M,
    }


def row(name: str, found: Measured) -> str:
    """Medians as a line of a Markdown table."""
    near = found.depth_m <= NEAR_M
    numbers = [
        f"{float(found.depth_error.median()):+.0%}",
        f"{float(found.center_error_m[near].median()):.2f} / {float(found.center_error_m.median()):.2f}",
        f"{float(found.yaw_error_deg.median()):.1f} / {float(found.yaw_error_deg.max()):.1f}",
        f"{float(found.box_iou[near].median()):.2f} / {float(found.box_iou.median()):.2f}",
        f"{float(found.size_iou.min()):.2f}",
        f"{float(found.envelope_iou.median()):.2f} / {float(found.envelope_iou.min()):.2f}",
        f"{float(found.envelope_iou_of_label.median()):.2f} / {float(found.envelope_iou_of_label.min()):.2f}",
    ]
    return f"| {name} | " + " | ".join(numbers) + " |"


def plot(series: dict[float, Measured]) -> bytes:
    """Centre error, 3-D IoU and envelope IoU over the focal length's error."""
    figure = Figure(figsize=(9.6, 3.0), layout="constrained")
    center, overlap, filter1 = figure.subplots(1, 3)
    percent = [100 * error for error in series]
    for colour, name in zip((BLUE, TEAL, AMBER), groups(next(iter(series.values()))), strict=True):
        for axes, value in ((center, "center_error_m"), (overlap, "box_iou")):
            medians = [float(getattr(found, value)[groups(found)[name]].median()) for found in series.values()]
            axes.plot(percent, medians, color=colour, label=name, linewidth=1.8)
    for colour, value, name in (
        (BLUE, "envelope_iou", "DD3D's box"),
        (AMBER, "envelope_iou_of_label", "a right box"),
    ):
        medians = [float(getattr(found, value).median()) for found in series.values()]
        worst = [float(getattr(found, value).min()) for found in series.values()]
        filter1.plot(percent, medians, color=colour, label=name, linewidth=1.8)
        filter1.plot(percent, worst, color=colour, linewidth=1.0, linestyle=":")
    finish(center, "Centre error (m), median", limit=None)
    finish(overlap, "3-D IoU, median", limit=1.03)
    finish(filter1, "Envelope IoU, median and worst", limit=1.03)
    return figure_bytes(figure, "png")


def finish(axes: Axes, title: str, *, limit: float | None) -> None:
    """Labels and the look of our plots."""
    dress(axes, title)
    axes.set_xlabel("focal length wrong by (%)", color=INK, fontsize=9)
    axes.set_ylim(0, limit)
    axes.legend(frameon=False, fontsize=8, labelcolor=INK)


def main(analysis: Analysis) -> None:
    """Print the table, write the plot."""
    labels = read_labels(analysis.root)
    series = {error: measure(labels, error) for error in ERRORS}
    counts = {name: int(which.sum()) for name, which in groups(series[0.0]).items()}
    print(f"{sum(counts.values())} vehicles of {len(labels)} photos: {counts}; medians, for the near ones / for all\n")
    print("| focal length | depth | centre error, m | turned by, median / most deg | 3-D IoU | size IoU, least | "
          "envelope IoU, median / least | the same of a right box |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for error in SHOWN:
        print(row(f"{error:+.0%}", series[error]))
    print(row("right, principal point in the middle", measure(labels, 0.0, centred=True)))
    if analysis.plot is not None:
        write_bytes(analysis.plot, plot(series))


if __name__ == "__main__":
    main(tyro.cli(Analysis))
