"""Who takes a training step: the optimisers a recipe may name, codes kept per car at a rate of their own."""

from typing import Any, Literal

import torch

from carstudio.models.interface import CategoryModel

OptimizerName = Literal["radam", "adamw", "adam"]
EPSILON = 1e-8  # the paper's


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
