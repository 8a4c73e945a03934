"""The heads for inference: normalisations and learned scales folded into the convolutions, outputs predicted together.

The three towers share their convolutions over the levels but not their normalisations. So each level gets convolutions
of its own (fewer passes over memory), and every tower one predictor in place of up to five.
"""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.perception.dd3d.heads import FCOS2DHead, FCOS3DHead, HeadOutputs, SharedConv, Tower
from carstudio.perception.dd3d.layers import folded

Affine = tuple[nn.Module, Tensor | float, Tensor | float]  # predictor, factor and summand of its output


class LevelTower(nn.Module):
    """One tower with its predictors, for one level. The last convolution stays in float32, whatever the others are."""

    def __init__(self, tower: Tower, level: int, predictors: Iterable[Affine]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_plain(*_folded_layer(layer, level)) for layer in tower)
        parts = [_scaled(*predictor) for predictor in predictors]
        self.sizes = [len(bias) for _, bias in parts]
        weights, biases = zip(*parts, strict=True)
        self.predictor = _plain(torch.cat(weights), torch.cat(biases))

    def forward(self, x: Float[Tensor, "batch 256 rows columns"]) -> tuple[Float[Tensor, "batch _ rows columns"], ...]:
        """What each predictor gives."""
        for layer in self.layers:
            x = nn.functional.relu(layer(x), inplace=True)
        return self.predictor(x.float()).split(self.sizes, dim=1)


class FusedHeads(nn.Module):
    """Both heads, equal to `heads.look` but for the last digits."""

    def __init__(self, head2d: FCOS2DHead, head3d: FCOS3DHead) -> None:
        super().__init__()
        levels = range(len(head2d.scales_box2d_reg))
        self.of_class = nn.ModuleList(
            LevelTower(head2d.cls_tower, level, [(head2d.cls_logits, 1.0, 0.0)]) for level in levels
        )
        self.of_box2d = nn.ModuleList(
            LevelTower(
                head2d.box2d_tower,
                level,
                [(head2d.box2d_reg, head2d.scales_box2d_reg.of_level(level), 0.0), (head2d.centerness, 1.0, 0.0)],
            )
            for level in levels
        )
        self.of_box3d = nn.ModuleList(
            LevelTower(
                head3d.box3d_tower,
                level,
                [
                    (head3d.box3d_quat[0], 1.0, 0.0),
                    (head3d.box3d_ctr[0], head3d.scales_proj_ctr.of_level(level), 0.0),
                    (head3d.box3d_depth[0], head3d.scales_depth.of_level(level), head3d.offsets_depth.of_level(level)),
                    (head3d.box3d_size[0], head3d.scales_size.of_level(level), 0.0),
                    (head3d.box3d_conf[0], head3d.scales_conf.of_level(level), 0.0),
                ],
            )
            for level in levels
        )

    def forward(self, features: Sequence[Float[Tensor, "batch 256 _ _"]]) -> list[HeadOutputs]:
        """Raw outputs of each level."""
        outputs = []
        towers = zip(features, self.of_class, self.of_box2d, self.of_box3d, strict=True)
        for feature, of_class, of_box2d, of_box3d in towers:
            (logits,) = of_class(feature)
            box2d, centerness = of_box2d(feature)
            quaternion, center, depth, size, confidence = of_box3d(feature)
            outputs.append(
                HeadOutputs(logits, centerness, nn.functional.relu(box2d), quaternion, center, depth, size, confidence)
            )
        return outputs

    def set_precision(self, dtype: torch.dtype) -> None:
        """Towers compute in `dtype`, predictors in float32."""
        for tower in (*self.of_class, *self.of_box2d, *self.of_box3d):
            assert isinstance(tower, LevelTower), "heads hold towers"
            tower.layers.to(dtype)


def _folded_layer(layer: nn.Module, level: int) -> tuple[Tensor, Tensor]:
    assert isinstance(layer, SharedConv), "a tower holds shared convolutions"
    return folded(layer, layer.norm[level])


def _scaled(predictor: nn.Module, factor: Tensor | float, summand: Tensor | float) -> tuple[Tensor, Tensor]:
    assert isinstance(predictor, nn.Conv2d), "a predictor is a convolution"
    bias = predictor.weight.new_zeros(len(predictor.weight)) if predictor.bias is None else predictor.bias
    return predictor.weight * factor, bias * factor + summand


def _plain(weight: Tensor, bias: Tensor) -> nn.Conv2d:
    conv = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1, device="meta")
    conv.weight, conv.bias = nn.Parameter(weight.detach()), nn.Parameter(bias.detach())
    return conv
