"""Who takes a training step: the optimisers a recipe may name, codes kept per car at a rate of their own."""

from collections.abc import Sequence
from typing import Any, Literal

import torch

from carstudio.models.interface import CategoryModel

OptimizerName = Literal["radam", "adamw", "adam"]
EPSILON = 1e-8  # the paper's


def clip(parameters: Sequence[torch.nn.Parameter], largest: float) -> None:
    """Shorten the gradients to that norm, all as one vector, where they are longer; short ones are not touched."""
    norm = torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
    if float(norm) > largest:
        torch.nn.utils.clip_grads_with_norm_(parameters, largest, norm)


def build_optimizer(
    model: CategoryModel,
    name: OptimizerName,
    *,
    rate: float,
    second_moment: float = 0.999,
    code_rate: float = 1.0,
    template_rate: float = 1.0,
) -> torch.optim.Optimizer:
    """The optimiser over a model's parameters; each group's `multiple` times the schedule's rate is its rate.

    RAdam with the paper's epsilon, AdamW with torch's weight decay of 0.01 (as CodeNeRF's code), or Adam in one fused
    kernel. All keep the same state per parameter.
    """
    own = [(model.code_parameters(), code_rate), (model.template_parameters(), template_rate)]
    ids = {id(parameter) for parameters, _ in own for parameter in parameters}
    groups: list[dict[str, Any]] = [
        {"params": [p for p in model.parameters() if id(p) not in ids], "multiple": 1.0, "lr": rate}
    ]
    for parameters, multiple in own:
        if parameters:
            groups.append({"params": list(parameters), "multiple": multiple, "lr": rate * multiple})
    betas = (0.9, second_moment)
    if name == "radam":
        return torch.optim.RAdam(groups, lr=rate, betas=betas, eps=EPSILON)
    if name == "adamw":
        return torch.optim.AdamW(groups, lr=rate, betas=betas, eps=EPSILON)
    return torch.optim.Adam(groups, lr=rate, betas=betas, eps=EPSILON, fused=True)
