"""Optimisers, processor seconds, and which cars are trained on."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from carstudio.commands.train import Train
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.models.car_gaussians import CarGaussiansConfig
from carstudio.models.code_nerf import CodeNeRFConfig
from carstudio.models.encoders import EncoderConfig
from carstudio.models.interface import CategoryModel, Latents
from carstudio.models.zoo import build_model
from carstudio.rendering.field import SamplingConfig
from carstudio.training.batches import training_patches
from carstudio.training.checkpoint import load_model
from carstudio.training.config import TrainConfig
from carstudio.training.log import read_log
from carstudio.training.losses import LossConfig, code_length, mask_error
from carstudio.training.optimizers import build_optimizer, clip
from carstudio.training.resume import load_state
from carstudio.training.trainer import train
from training.toy import TINY, toy_store

CODED = dataclasses.replace(
    TINY,
    model=CodeNeRFConfig(sampling=SamplingConfig(8, 0), code_size=8, width=16),
    loss=LossConfig(colour="whole-crop", mask_weight=0.0, code_weight=1e-4),
    optimizer="adamw",
    code_rate=10.0,
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store", cars=5)


class KilledError(Exception):
    """Stands for SIGKILL right after a checkpoint."""


@pytest.mark.parametrize("config", [dataclasses.replace(TINY, optimizer="adam"), CODED], ids=["fused adam", "codes"])
def test_resume_is_bit_identical_for_every_optimiser(store: PatchStore, tmp_path: Path, config: TrainConfig) -> None:
    def kill(model: CategoryModel, step: int) -> None:
        if step == 8:
            raise KilledError

    torch.set_num_threads(1)
    train(config, store, tmp_path / "whole", device="cpu")
    with pytest.raises(KilledError):
        train(config, store, tmp_path / "parts", device="cpu", on_save=kill)
    train(config, store, tmp_path / "parts", device="cpu", resume=True)
    for name in ("model.safetensors", "model.json", "log.jsonl"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name


def test_the_cars_codes_are_trained_and_found_again(store: PatchStore, tmp_path: Path) -> None:
    train(CODED, store, tmp_path, device="cpu")
    trained = load_model(tmp_path)
    assert trained.config.cars == tuple(f"toy-{car}" for car in range(5))
    assert "codes" in read_log(tmp_path / "log.jsonl")[-1]


@pytest.mark.parametrize("largest", [0.5, 100.0])
def test_gradients_are_clipped_as_torch_clips_them(largest: float) -> None:
    ours, theirs = ([torch.nn.Parameter(torch.zeros(n)) for n in (3, 40, 5)] for _ in range(2))
    for mine, other in zip(ours[:2], theirs[:2], strict=True):  # the third has no gradient
        mine.grad = torch.randn(mine.shape, generator=torch.Generator().manual_seed(len(mine)))
        other.grad = mine.grad.clone()
    clip(ours, largest)
    torch.nn.utils.clip_grad_norm_(theirs, largest)
    for mine, other in zip(ours[:2], theirs[:2], strict=True):
        assert torch.equal(torch.as_tensor(mine.grad), torch.as_tensor(other.grad))


def test_codes_learn_at_their_own_rate() -> None:
    """One step of Adam moves every number by its rate, whatever the gradient: an oracle for who got which rate."""
    torch.manual_seed(0)
    model = build_model(CodeNeRFConfig(code_size=8, width=16, cars=("a", "b")))
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    optimizer = build_optimizer(model, "adam", rate=1e-3, code_rate=10.0)
    for parameter in model.parameters():
        parameter.grad = torch.full_like(parameter, 0.3)
    optimizer.step()
    for name, value in model.named_parameters():
        moved = (before[name] - value).abs()
        expected = 1e-2 if name.endswith("_codes") else 1e-3
        assert torch.allclose(moved, torch.full_like(moved, expected), rtol=1e-3), name
    assert sum(len(group["params"]) for group in optimizer.param_groups) == len(before)


def test_a_templates_numbers_learn_at_their_own_rate() -> None:
    torch.manual_seed(0)
    encoder = EncoderConfig(kind="small", side_px=32, pretrained=None, num_features=8)
    model = build_model(CarGaussiansConfig(encoder=encoder, num_splats=16, code_size=8, width=8, blocks=1))
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    optimizer = build_optimizer(model, "adam", rate=1e-3, template_rate=20.0)
    for parameter in model.parameters():
        parameter.grad = torch.full_like(parameter, 0.3)
    optimizer.step()
    own = {name for name, _ in model.field_parameters()}
    assert len(own) == 7
    for name, value in model.named_parameters():
        moved = (before[name] - value).abs()
        assert torch.allclose(moved, torch.full_like(moved, 2e-2 if name in own else 1e-3), rtol=1e-3), name


@pytest.mark.parametrize(
    ("name", "reference"),
    [("radam", torch.optim.RAdam), ("adamw", torch.optim.AdamW), ("adam", torch.optim.Adam)],
)
@pytest.mark.parametrize("second_moment", [0.999, 0.9])
def test_each_optimiser_is_torchs(name: str, reference: type[torch.optim.Optimizer], second_moment: float) -> None:
    torch.manual_seed(0)
    ours, theirs = (build_model(CodeNeRFConfig(code_size=8, width=16, cars=("a",))) for _ in range(2))
    theirs.load_state_dict(ours.state_dict())
    pair = (
        build_optimizer(ours, name, rate=1e-2, second_moment=second_moment),  # type: ignore[arg-type]
        reference(theirs.parameters(), lr=1e-2, betas=(0.9, second_moment), eps=1e-8),  # type: ignore[call-arg]
    )
    for step in range(8):
        for model, optimizer in zip((ours, theirs), pair, strict=True):
            generator = torch.Generator().manual_seed(step)
            for parameter in model.parameters():
                parameter.grad = torch.randn(parameter.shape, generator=generator)
            optimizer.step()
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.allclose(mine, other, atol=1e-6)


def test_a_run_by_processor_seconds_ends_and_goes_on(
    store: PatchStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that moves 0.5 s a look: 1 s a step would be two looks; the budget of 4 s is spent after eight."""
    import carstudio.training.trainer as trainer

    ticks = iter(range(1_000_000))
    monkeypatch.setattr(trainer.time, "process_time", lambda: next(ticks) * 0.5)
    config = dataclasses.replace(TINY, cpu_seconds=4.0, save_every=3)

    def kill(model: CategoryModel, step: int) -> None:
        if step == 3:
            raise KilledError

    with pytest.raises(KilledError):
        train(config, store, tmp_path, device="cpu", on_save=kill)
    assert load_state(tmp_path).cpu_seconds == pytest.approx(1.5)
    summary = train(config, store, tmp_path, device="cpu", resume=True)
    assert (summary.steps, summary.cpu_seconds) == (8, 4.0)
    assert read_log(tmp_path / "log.jsonl")[-1]["cpu_seconds"] == 4.0
    rates = [row["learning_rate"] for row in read_log(tmp_path / "log.jsonl")]
    assert rates[-1] < rates[0]  # the schedule follows the processors


@pytest.mark.parametrize(("length", "expected"), [({"cpu_seconds": 0.2}, 1), ({"steps": 2}, 3)])
def test_a_run_by_processor_time_keeps_to_one_thread(
    store: PatchStore, tmp_path: Path, length: dict[str, float], expected: int
) -> None:
    seen: list[int] = []
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        config = dataclasses.replace(TINY, **length)
        train(config, store, tmp_path, device="cpu", on_save=lambda *_: seen.append(torch.get_num_threads()))
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
    assert set(seen) == {expected}


def test_a_teams_processor_seconds_are_added_up(store: PatchStore, tmp_path: Path) -> None:
    """Two processes start at the same moment and share each step: together they spend more than one thread could."""
    config = dataclasses.replace(TINY, cpu_seconds=1.0)
    summary = train(config, store, tmp_path, device="cpu", processes=2)
    assert summary.cpu_seconds >= 1.0
    assert summary.steps >= 1
    assert summary.cpu_seconds < 2 * summary.seconds + 0.5


def test_fewer_cars_are_among_the_more(store: PatchStore) -> None:
    chosen = [set(training_patches(store, split=None, most_cars=n).values()) for n in (1, 2, 4, 99)]
    assert [len(cars) for cars in chosen] == [1, 2, 4, 5]
    assert chosen[0] < chosen[1] < chosen[2] < chosen[3]
    two = training_patches(store, split=None, most_cars=2)
    assert len(two) == 8, "all four photos of each"
    assert list(two) == [name for name in store.patch_ids() if name in two], "in the store's order"


def test_cars_with_few_photos_can_be_left_out(store: PatchStore) -> None:
    assert len(training_patches(store, split="view", least_views=2)) == 10  # two of four photos train
    with pytest.raises(InputError, match="of cars with 3 or more photos in the training part of split 'view'"):
        training_patches(store, split="view", least_views=3)


def test_the_occupancy_loss_is_autorfs_formula() -> None:
    """-log(y (1/2 - t) + 1/2) with t the light that gets through; torch's binary cross-entropy is a second opinion."""
    opacity = torch.tensor([[0.02, 0.3, 0.9, 0.999]], dtype=torch.float64, requires_grad=True)
    for alpha in (0.0, 1.0):
        found = mask_error(opacity, torch.full_like(opacity, alpha), "log")
        y = 1.0 if alpha else -1.0
        by_hand = [-math.log(y * (0.5 - (1 - o)) + 0.5) for o in opacity[0].tolist()]
        assert found[0].tolist() == pytest.approx(by_hand, rel=1e-9)
        entropy = torch.nn.functional.binary_cross_entropy(opacity, torch.full_like(opacity, alpha), reduction="none")
        assert torch.allclose(found, entropy, rtol=1e-9)
    extreme = torch.tensor([[0.0, 1.0]], requires_grad=True)
    mask_error(extreme, torch.tensor([[1.0, 0.0]]), "log").sum().backward()
    assert extreme.grad is not None
    assert bool(torch.isfinite(extreme.grad).all())


def test_the_length_of_codes_is_euclids() -> None:
    latents = Latents(torch.tensor([[3.0, 4.0], [0.0, 0.0]]), torch.tensor([[0.0], [-2.0]]))
    assert float(code_length(latents)) == pytest.approx((5 + 0 + 0 + 2) / 2)


def test_the_command_line_names_budget_and_optimiser(tmp_path: Path) -> None:
    command = Train(recipe="car-gaussians", data=tmp_path, out=tmp_path, cpu_seconds=9.0, optimizer="adam")
    assert (command.config().cpu_seconds, command.config().optimizer) == (9.0, "adam")
    plain = Train(recipe="code-nerf", data=tmp_path, out=tmp_path).config()
    assert (plain.cpu_seconds, plain.optimizer) == (None, "adamw")
    assert (
        Train(recipe="car-gaussians", data=tmp_path, out=tmp_path, patches_per_step=64).config().patches_per_step == 64
    )
    with pytest.raises(InputError, match="patches-per-step must be 1 or more, found 0"):
        Train(recipe="car-gaussians", data=tmp_path, out=tmp_path, patches_per_step=0).config()
    with pytest.raises(InputError, match="give one"):
        Train(recipe="car-nerf", data=tmp_path, out=tmp_path, cpu_seconds=9.0, minutes=1.0).config()
