"""Detector `transformers:NAME_OR_FOLDER`: 2-D boxes of vehicles by D-FINE, RT-DETR (v1, v2), DETR, YOLOS and their kin.

These networks answer with a fixed number of queries, each a box (centre and size as shares of the photograph) and one
logit per class. A query speaks for its most probable class only; two queries that see one vehicle as two classes are
reduced to the surer one.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.perception.hub_models import Precision, low_precision, read_config, read_network, read_preprocessing
from carstudio.perception.preprocessing import Preprocessing
from carstudio.perception.results import Detection2D, Photo
from carstudio.perception.suppression import without_doubles
from carstudio.perception.vehicle_classes import vehicle_classes
from carstudio.perception.weights import DEFAULT_DETECTOR

SPEC = "transformers"
_YOLOS_STEP = 16  # its image processor cuts the sides to multiples of this, and says so in no file
_GPU_BATCH = 8


@dataclass(frozen=True)
class TransformersDetector:
    """Boxes of vehicles. Holds settings only: the network is loaded by each process that asks, once."""

    name: str = DEFAULT_DETECTOR
    """Hub name, or folder as save_pretrained writes it."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""
    threshold: float = 0.3
    """Boxes of less confidence are left out; the filters of a build set stricter ones."""
    same_iou: float = 0.8
    """Of two boxes that overlap more than this (IoU) the less confident is left out, whatever their classes."""
    batch: int | None = None
    """Photographs per forward pass; None: 8 on a GPU, 1 on a CPU, where more give nothing."""
    precision: Precision = "auto"
    """auto: float16 on CUDA, float32 elsewhere."""

    def detect(self, photos: Sequence[Photo]) -> list[list[Detection2D]]:
        """For each photograph its boxes, px, clipped to it, in descending order of confidence."""
        detector = open_network(self.name, self.device)
        size = self.batch or (1 if detector.device.type == "cpu" else _GPU_BATCH)
        results: list[list[Detection2D]] = [[] for _ in photos]
        pixels = [detector.preprocessing.pixels(photo.image) for photo in photos]
        for indices in _batches([tuple(item.shape) for item in pixels], size):
            # Always full, the last photograph repeated: kernels differ with the batch's size, and so would results.
            full = indices + indices[-1:] * (size - len(indices))
            logits, boxes = detector.forward(torch.stack([pixels[i] for i in full]), self.precision)
            for row, index in enumerate(indices):
                height, width = photos[index].image.shape[:2]
                results[index] = self._read(detector, logits[row], boxes[row], width, height)
        return results

    def _read(
        self,
        detector: "LoadedDetector",
        logits: Float[Tensor, "query classes"],
        boxes: Float[Tensor, "query 4"],
        width: int,
        height: int,
    ) -> list[Detection2D]:
        scores, classes = detector.confidence(logits).max(dim=-1)
        edges = edges_px(boxes.double().numpy(), width, height)
        is_vehicle = torch.tensor([int(index) in detector.types for index in classes])
        has_area = torch.from_numpy((edges[:, 2] > edges[:, 0]) & (edges[:, 3] > edges[:, 1]))
        candidates = torch.nonzero(is_vehicle & has_area & (scores > self.threshold))[:, 0]
        order = candidates[torch.argsort(scores[candidates], descending=True, stable=True)].tolist()
        kept = without_doubles(edges, order, self.same_iou)
        return [
            Detection2D(
                (float(edges[i, 0]), float(edges[i, 1]), float(edges[i, 2]), float(edges[i, 3])),
                detector.types[int(classes[i])],
                float(scores[i]),
            )
            for i in kept
        ]


@dataclass(frozen=True)
class LoadedDetector:
    """A network with what is needed to ask it and to read its answers."""

    network: nn.Module
    preprocessing: Preprocessing
    types: Mapping[int, str]  # class index -> our type
    num_classes: int
    device: torch.device
    name: str

    @torch.inference_mode()
    def forward(
        self, pixels: Float[Tensor, "photo 3 rows columns"], precision: Precision
    ) -> tuple[Float[Tensor, "photo query classes"], Float[Tensor, "photo query 4"]]:
        """Logits, and boxes as centre and size in shares of the photograph; float32 on the CPU."""
        with low_precision(precision, self.device):
            output = self.network(pixel_values=pixels.to(self.device))
        logits, boxes = output.logits.float().cpu(), output.pred_boxes.float().cpu()
        if not (torch.isfinite(logits).all() and torch.isfinite(boxes).all()):
            raise InputError(f"{SPEC}:{self.name}: the network answers with NaN; are its weights damaged?")
        return logits, boxes

    def confidence(self, logits: Float[Tensor, "query classes"]) -> Float[Tensor, "query named"]:
        """Probability of each named class: independent ones, or DETR's softmax with "no object" as the last class."""
        if logits.shape[-1] == self.num_classes + 1:
            return logits.softmax(dim=-1)[:, :-1]
        if logits.shape[-1] == self.num_classes:
            return logits.sigmoid()
        raise InputError(
            f"{SPEC}:{self.name}: expected {self.num_classes} logits per box, as id2label has names, or one more, "
            f"found {logits.shape[-1]}; give id2label of its config.json a name for each class"
        )


@lru_cache(maxsize=2)
def open_network(name: str, device: str) -> LoadedDetector:
    """Load a detector, once per process; `InputError` when there is none, or none that knows vehicles."""
    from transformers import AutoModelForObjectDetection
    from transformers.models.auto.modeling_auto import MODEL_FOR_OBJECT_DETECTION_MAPPING_NAMES

    config = read_config(name, tuple(MODEL_FOR_OBJECT_DETECTION_MAPPING_NAMES), spec=SPEC)
    types = vehicle_classes(config.id2label, model=f"{SPEC}:{name}")
    step = _YOLOS_STEP if config.model_type == "yolos" else 1
    preprocessing = read_preprocessing(name, spec=SPEC, step=step)
    network = read_network(AutoModelForObjectDetection.from_pretrained, name, spec=SPEC)
    place = pick_device(device)
    return LoadedDetector(network.to(place), preprocessing, types, len(config.id2label), place, name)


def edges_px(boxes: Float[np.ndarray, "n 4"], width: int, height: int) -> Float[np.ndarray, "n 4"]:
    """Centre and size in shares of the photograph -> x0, y0, x1, y1 px, clipped to it."""
    center, half = boxes[:, :2], boxes[:, 2:] / 2
    edges = np.concatenate([center - half, center + half], axis=1)
    limit = np.array([width, height, width, height], np.float64)
    return np.clip(edges * limit, 0.0, limit)


def _batches(shapes: Sequence[tuple[int, ...]], size: int) -> Iterator[list[int]]:
    """Indices of equal shapes, at most `size` at a time."""
    for shape in dict.fromkeys(shapes):
        indices = [i for i, other in enumerate(shapes) if other == shape]
        for start in range(0, len(indices), size):
            yield indices[start : start + size]
