"""Speed of DD3D: a straightforward port against ours, one photo through the network and its decoding.

Usage: python bench/dd3d.py [--backbones dla34 v2-99] [--height 384] [--width 1280] [--rounds 5] [--device auto]

The port: the layers as trained (normalisations apart, heads level by level, one predictor after the other), pixels
channel after channel, candidates and suppression level by level and box by box. Ours: what `--box3d dd3d:` runs, in
float32 and in bfloat16. Weights are random, so that nothing of the network depends on a download; scores are shifted to
give as many candidates as a street does. Rounds are interleaved, and the ratio is within the round.
"""

import copy
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
import tyro

from carstudio.devices import pick_device
from carstudio.geometry.camera import Camera
from carstudio.geometry.overlap import box2d_iou
from carstudio.perception.dd3d.decoding import Detections, Selection, candidates
from carstudio.perception.dd3d.model import DD3D, Backbone, DD3DConfig

LOGIT_BIAS = -3.5  # of the classes: random logits then give a few thousand candidates


@dataclass(frozen=True)
class Bench:
    """What to time."""

    backbones: tuple[Backbone, ...] = ("dla34", "v2-99")
    height: int = 384
    width: int = 1280
    rounds: int = 5
    device: str = "auto"


def random_network(backbone: Backbone, image: torch.Tensor) -> DD3D:
    """Raw outputs of spread 1, about a class logit of `LOGIT_BIAS`."""
    torch.manual_seed(0)
    network = DD3D(DD3DConfig(backbone)).eval().requires_grad_(False)
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d):
            torch.nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
    outputs = network(network.prepare([image]))
    heads2d, heads3d = network.fcos2d_head, network.fcos3d_head
    for predictor, name in (
        (heads2d.cls_logits, "logits"),
        (heads2d.box2d_reg, "box2d"),
        (heads2d.centerness, "centerness"),
        (heads3d.box3d_conf[0], "confidence"),
    ):
        values = torch.cat([getattr(level, name).flatten() for level in outputs])
        assert isinstance(predictor, torch.nn.Conv2d)
        predictor.weight.div_(values.std())
    for predictor, bias in ((heads2d.cls_logits, LOGIT_BIAS), (heads2d.box2d_reg, 4.0)):
        assert predictor.bias is not None
        predictor.bias.fill_(bias)
    return network


def port(network: DD3D, image: torch.Tensor, camera: Camera) -> Detections:
    """One step after the other, as the original goes: level by level, then box by box."""
    pixels = network.prepare([image])
    parts = []
    for level, (outputs, stride) in enumerate(zip(network(pixels), network.backbone.strides, strict=True)):
        (found,) = candidates([outputs], [stride], camera, network.canonical_sizes, Selection())
        parts.append(Detections(**{**vars(found), "level": torch.full_like(found.level, level)}))
    found = Detections(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))
    found = found.chosen(found.score_3d.argsort(descending=True))
    kept: list[int] = []
    for kind in found.kind.unique().tolist():
        rest = torch.nonzero(found.kind == kind)[:, 0]
        while len(rest):
            kept.append(int(rest[0]))
            iou = box2d_iou(found.box2d[rest[:1]], found.box2d[rest[1:]])
            rest = rest[1:][iou <= network.config.suppression.most_iou]
    found = found.chosen(torch.tensor(sorted(kept), dtype=torch.long, device=image.device))
    most = network.config.suppression.most_boxes
    return found if len(found) <= most else found.chosen(found.score_2d >= found.score_2d.topk(most).values[-1])


def seconds(action: Callable[[], object], device: torch.device) -> tuple[float, float]:
    """(wall, processor) of one call, the device's queue drained."""
    wall, processor = time.perf_counter(), time.process_time()
    action()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - wall, time.process_time() - processor


@torch.inference_mode()
def measured(backbone: Backbone, bench: Bench, device: torch.device) -> dict[str, list[tuple[float, float]]]:
    """Seconds of each way, round by round."""
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (3, bench.height, bench.width), generator=generator, dtype=torch.uint8).to(device)
    camera = Camera(torch.tensor([739.0, 739.0, bench.width / 2, bench.height / 2]), bench.width, bench.height)
    batch = Camera(camera.intrinsics[None].to(device), bench.width, bench.height)
    plain = random_network(backbone, image.cpu())
    fused = copy.deepcopy(plain).fuse()
    low = copy.deepcopy(fused).set_precision(torch.bfloat16).to(device)
    plain, fused = plain.to(device), fused.to(device)
    ways: dict[str, Callable[[], object]] = {
        "port": lambda: port(plain, image, batch),
        "ours": lambda: fused.detect([image], [camera]),
        "ours, bfloat16": lambda: low.detect([image], [camera]),
    }
    found = port(plain, image, batch), fused.detect([image], [camera])[0]
    same = set(zip(*(found[0].__dict__[n].tolist() for n in ("level", "cell", "kind")), strict=True))
    same &= set(zip(*(found[1].__dict__[n].tolist() for n in ("level", "cell", "kind")), strict=True))
    print(f"{backbone}: {len(found[0])} boxes by the port, {len(found[1])} by ours, {len(same)} in common")
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for way in ways.values():
        way()
    for _ in range(bench.rounds):
        for name, way in ways.items():
            taken[name].append(seconds(way, device))
    return taken


def main(bench: Bench) -> None:
    """Run and print a Markdown table."""
    device = pick_device(bench.device)
    clock = 1 if device.type == "cpu" else 0  # processor seconds on a CPU, which others share
    rows = []
    for backbone in bench.backbones:
        taken = measured(backbone, bench, device)
        for name, values in taken.items():
            own = [value[clock] for value in values]
            ratio = statistics.median(a[clock] / b for a, b in zip(taken["port"], own, strict=True))
            rows.append(f"| {backbone} | {name} | {statistics.median(own):.3f} | {ratio:.2f} |")
    kind = "processor seconds" if clock else "seconds"
    print(
        f"\ntorch {torch.__version__}, {device}, {torch.get_num_threads()} threads, {platform.machine()}; one photo of "
        f"{bench.width} x {bench.height} px; medians of {bench.rounds} interleaved rounds.\n"
    )
    print(f"| backbone | way | {kind} | times as fast as the port |\n|---|---|---:|---:|")
    print("\n".join(rows))


if __name__ == "__main__":
    main(tyro.cli(Bench))
