"""Segmenter `sam:NAME_OR_FOLDER`: Segment Anything (Kirillov et al., ICCV 2023), prompted with the 2-D box.

The released CarPatch3D was cut out so: ViT-H, one mask per box, predicted IoU above 0.6.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from jaxtyping import Float
from torch import Tensor

from carstudio.devices import pick_device
from carstudio.perception.box_prompts import BoxPromptSegmenter, LoadedSam, interpolate
from carstudio.perception.hub_models import read_config, read_network, read_preprocessing
from carstudio.perception.preprocessing import Size
from carstudio.perception.weights import DEFAULT_SAM

SPEC = "sam"


@dataclass(frozen=True, kw_only=True)
class SamSegmenter(BoxPromptSegmenter):
    """SAM 1: the photograph's longer side is resized to 1024 px, the rest of the square is zeros."""

    name: str = DEFAULT_SAM

    def open(self) -> LoadedSam:
        """Load the network, once per process."""
        return open_sam(self.name, self.device)

    def embed(self, network: Any, pixels: Float[Tensor, "1 3 side side"]) -> Float[Tensor, "1 channel rows columns"]:
        """The image embedding."""
        embedding: Tensor = network.get_image_embeddings(pixels)
        return embedding.float()

    def decode(self, network: Any, embedding: Any, boxes: Float[Tensor, "1 box 4"]) -> Any:
        """Masks at a quarter of the square's side."""
        return network(image_embeddings=embedding, input_boxes=boxes, multimask_output=self.multimask)

    def to_photo(self, logits: Float[Tensor, "rows columns"], loaded: LoadedSam, size: Size) -> Tensor:
        """Up to the square, without its padding, then to the photograph, as the original does."""
        square = interpolate(logits, (loaded.side, loaded.side))
        height, width = loaded.preprocessing.resized(size)
        return interpolate(square[:height, :width], size)


@lru_cache(maxsize=2)
def open_sam(name: str, device: str) -> LoadedSam:
    """Load a SAM; `InputError` when there is none."""
    from transformers import SamModel

    config = read_config(name, ("sam",), spec=SPEC)
    preprocessing = read_preprocessing(name, spec=SPEC)
    place = pick_device(device)
    network = read_network(SamModel.from_pretrained, name, spec=SPEC).to(place)
    return LoadedSam(network, preprocessing, int(config.vision_config.image_size), place)
