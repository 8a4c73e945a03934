"""Segmenter `sam2:NAME_OR_FOLDER`: SAM 2 (Ravi et al., 2024) on single photographs, prompted with the 2-D box."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from jaxtyping import Float
from torch import Tensor

from carstudio.devices import pick_device
from carstudio.perception.box_prompts import BoxPromptSegmenter, LoadedSam, interpolate
from carstudio.perception.hub_models import read_config, read_network, read_preprocessing
from carstudio.perception.preprocessing import Size
from carstudio.perception.weights import DEFAULT_SAM2

SPEC = "sam2"


@dataclass(frozen=True, kw_only=True)
class Sam2Segmenter(BoxPromptSegmenter):
    """SAM 2: the photograph is squeezed into the square of 1024 px, whatever its aspect ratio.

    Asked for one mask, the network itself replaces an unstable one by the best of its three.
    """

    name: str = DEFAULT_SAM2

    def open(self) -> LoadedSam:
        """Load the network, once per process."""
        return open_sam2(self.name, self.device)

    def embed(self, network: Any, pixels: Float[Tensor, "1 3 side side"]) -> list[Tensor]:
        """The image embedding and two finer feature maps."""
        return [level.float() for level in network.get_image_embeddings(pixels)]

    def decode(self, network: Any, embedding: Any, boxes: Float[Tensor, "1 box 4"]) -> Any:
        """Masks at a quarter of the square's side."""
        return network(image_embeddings=list(embedding), input_boxes=boxes, multimask_output=self.multimask)

    def to_photo(self, logits: Float[Tensor, "rows columns"], loaded: LoadedSam, size: Size) -> Tensor:
        """Straight to the photograph: there is no padding."""
        return interpolate(logits, size)


@lru_cache(maxsize=2)
def open_sam2(name: str, device: str) -> LoadedSam:
    """Load a SAM 2; `InputError` when there is none. The hub's files are those of its video model, of which a part."""
    from transformers import Sam2Model

    config = read_config(name, ("sam2", "sam2_video"), spec=SPEC)
    preprocessing = read_preprocessing(name, spec=SPEC)
    place = pick_device(device)
    network = read_network(Sam2Model.from_pretrained, name, spec=SPEC).to(place)
    size = config.prompt_encoder_config.image_size
    side = int(size if isinstance(size, int) else size[0])
    return LoadedSam(network, preprocessing, side, place)
