import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch

from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError, Interrupted
from carstudio.evaluation.protocols import EvaluationConfig, score_views, view_pairs
from carstudio.models.interface import CategoryModel
from carstudio.training.checkpoint import describe_model, load_model
from carstudio.training.log import read_log
from carstudio.training.resume import saved_step
from carstudio.training.schedule import ScheduleConfig, learning_rate
from carstudio.training.trainer import train
from training.toy import TINY, toy_store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store")


def test_it_learns_the_toy_cars(store: PatchStore, tmp_path: Path) -> None:
    """Shape and colours of three ellipsoids: silhouettes overlap well and novel views beat a grey car by far."""
    train(dataclasses.replace(TINY, steps=300), store, tmp_path / "run", device="cpu")
    model = load_model(tmp_path / "run")
    pairs = view_pairs(store, EvaluationConfig(protocol="novel-view", split=None))
    views = list(score_views(model, store, pairs))
    iou = sum(view.scores.mask_iou or 0 for view in views) / len(views)
    psnr = sum(view.scores.psnr or 0 for view in views) / len(views)
    assert len(views) == 12
    assert iou > 0.85, iou
    assert psnr > 17.0, psnr  # a grey ellipsoid of the right shape scores about 13
    for view in views:
        assert view.pair.input_patch_id != view.pair.scored_patch_id


class KilledError(Exception):
    """Stands for SIGKILL right after a checkpoint."""


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(store: PatchStore, tmp_path: Path) -> None:
    def kill(model: CategoryModel, step: int) -> None:
        if step == 8:
            raise KilledError

    torch.set_num_threads(1)
    train(TINY, store, tmp_path / "whole", device="cpu")
    with pytest.raises(KilledError):
        train(TINY, store, tmp_path / "parts", device="cpu", on_save=kill)
    with (tmp_path / "parts" / "log.jsonl").open("a") as log:
        log.write('{"step": 10, "loss": 1.0}\n{"step": 11, "lo')  # what a kill between checkpoints leaves
    train(TINY, store, tmp_path / "parts", device="cpu", resume=True)
    for name in ("model.safetensors", "log.jsonl"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name
    assert [row["step"] for row in read_log(tmp_path / "parts" / "log.jsonl")] == [2, 4, 6, 8, 10, 12]


def test_a_run_resumed_after_its_end_is_done(store: PatchStore, tmp_path: Path) -> None:
    """A kill between the last checkpoint and the end of the process; its picture may be missing."""
    first = train(TINY, store, tmp_path, device="cpu")
    before = {name: (tmp_path / name).read_bytes() for name in ("model.safetensors", "log.jsonl")}
    drawn: list[int] = []
    again = train(TINY, store, tmp_path, device="cpu", resume=True, on_save=lambda model, step: drawn.append(step))
    assert (again.sha256, again.steps, again.psnr) == (first.sha256, 12, first.psnr)
    assert drawn == [12]
    assert before == {name: (tmp_path / name).read_bytes() for name in before}


def test_a_run_resumed_beyond_its_new_end_has_a_model(store: PatchStore, tmp_path: Path) -> None:
    """Stopped before its first checkpoint, then made shorter than what is done already."""
    with pytest.raises(Interrupted):
        train(TINY, store, tmp_path, device="cpu", should_stop=lambda: True)
    summary = train(dataclasses.replace(TINY, steps=1), store, tmp_path, device="cpu", resume=True)
    assert describe_model(tmp_path).provenance["step"] == summary.steps == 1


def test_a_run_killed_before_its_first_checkpoint_starts_again(store: PatchStore, tmp_path: Path) -> None:
    """With or without --resume: there is a sign of it (the log, a lock nobody holds), and nothing to go on from."""
    train(TINY, store, tmp_path / "whole", device="cpu")
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "log.jsonl").write_text('{"step": 2, "loss": 1.0}\n{"st')
    (tmp_path / "lock").mkdir()
    (tmp_path / "lock" / ".lock").touch()
    (tmp_path / "lock" / ".model-abcdefgh.partial.safetensors").touch()
    whole = tmp_path / "whole"
    for begun, resume in (("log", True), ("lock", False)):
        train(TINY, store, tmp_path / begun, device="cpu", resume=resume)
        names = {path.name for path in (tmp_path / begun).iterdir()}
        assert names == {path.name for path in whole.iterdir()}
        assert (tmp_path / begun / "log.jsonl").read_bytes() == (whole / "log.jsonl").read_bytes()


@pytest.mark.parametrize("stop_after", [1, 3, 4, 7])
def test_a_run_asked_to_stop_saves_the_step_and_goes_on(store: PatchStore, tmp_path: Path, stop_after: int) -> None:
    asked: list[int] = []

    def should_stop() -> bool:
        asked.append(1)
        return len(asked) == stop_after

    torch.set_num_threads(1)
    train(TINY, store, tmp_path / "whole", device="cpu")
    with pytest.raises(Interrupted):
        train(TINY, store, tmp_path / "parts", device="cpu", should_stop=should_stop)
    assert saved_step(tmp_path / "parts") == stop_after
    train(TINY, store, tmp_path / "parts", device="cpu", resume=True)
    for name in ("model.safetensors", "log.jsonl"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name


def test_a_run_by_the_clock_saves_its_last_step(
    store: PatchStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock strikes between two questions after one step: 0.5 s per look, the end after 3 s."""
    import carstudio.training.trainer as trainer

    ticks = iter(range(1_000_000))
    monkeypatch.setattr(trainer.time, "monotonic", lambda: next(ticks) * 0.5)
    summary = train(dataclasses.replace(TINY, minutes=0.05), store, tmp_path, device="cpu")
    assert summary.steps == saved_step(tmp_path) == read_log(tmp_path / "log.jsonl")[-1]["step"]


def test_a_second_run_does_not_overwrite_the_first(store: PatchStore, tmp_path: Path) -> None:
    train(TINY, store, tmp_path, device="cpu")
    with pytest.raises(InputError, match="--resume"):
        train(TINY, store, tmp_path, device="cpu")
    with pytest.raises(InputError, match="nothing to resume"):
        train(TINY, store, tmp_path / "empty", device="cpu", resume=True)


def test_nan_stops_with_step_cars_and_term(store: PatchStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import carstudio.training.trainer as trainer

    real = trainer.training_loss

    def poisoned(*arguments: object) -> dict[str, torch.Tensor]:
        terms = real(*arguments)  # type: ignore[arg-type]
        return {**terms, "mask_fine": terms["mask_fine"] * math.nan}

    monkeypatch.setattr(trainer, "training_loss", poisoned)
    with pytest.raises(FloatingPointError, match=r"step 0: loss term mask_fine is nan for cars \['toy-"):
        train(TINY, store, tmp_path, device="cpu")


def test_the_model_file_says_where_it_comes_from(store: PatchStore, tmp_path: Path) -> None:
    summary = train(TINY, store, tmp_path, device="cpu", provenance={"data_sha256": store.data_sha256})
    description = describe_model(tmp_path)
    assert description.config == TINY.model
    assert description.provenance["recipe"] == "tiny"
    assert description.provenance["step"] == summary.steps == 12
    assert description.provenance["data_sha256"] == store.data_sha256
    assert description.sha256 == summary.sha256


def test_broken_models_are_refused_with_a_reason(store: PatchStore, tmp_path: Path) -> None:
    train(TINY, store, tmp_path, device="cpu")
    weights, description = tmp_path / "model.safetensors", tmp_path / "model.json"
    good, text = weights.read_bytes(), description.read_text()

    weights.write_bytes(good[: len(good) // 2])
    with pytest.raises(InputError, match="not a whole safetensors"):
        load_model(tmp_path)
    weights.write_bytes(good[:-4] + b"\x00\x00\x80\x3f")
    with pytest.raises(InputError, match="sha256"):
        load_model(tmp_path)
    weights.write_bytes(good)

    value = json.loads(text)
    for change, message in (
        ({"format_version": 99}, "format_version 1, found 99"),
        ({"config": {**value["config"], "kind": "other"}}, "model kind"),
        ({"config": {**value["config"], "wings": 2}}, "unknown fields"),
        ({"config": {**value["config"], "width": "wide"}}, "'width'"),
        ({"config": {**value["config"], "width": 48}}, "shape"),
        ({"config": {**value["config"], "width": 10**9}}, r"config\.width = 1000000000 must lie between"),
        ({"config": {**value["config"], "depth": -1}}, r"config\.depth = -1 must lie between"),
    ):
        description.write_text(json.dumps({**value, **change}))
        with pytest.raises(InputError, match=message):
            load_model(tmp_path)
    description.unlink()
    with pytest.raises(InputError, match="expected a trained model"):
        load_model(tmp_path)


def test_schedules() -> None:
    paper = ScheduleConfig()
    assert learning_rate(paper, 0, 0.0) == pytest.approx(1e-3)
    assert learning_rate(paper, 100_000, 0.2) == pytest.approx(math.sqrt(1e-3 * 1e-4))
    assert learning_rate(paper, 200_000, 0.4) == pytest.approx(1e-4)
    assert learning_rate(paper, 500_000, 1.0) == pytest.approx(1e-4)
    small = ScheduleConfig(first=2e-3, last=2e-4, decay_steps=None, warmup_steps=10)
    assert learning_rate(small, 0, 0.0) == pytest.approx(2e-4)
    assert learning_rate(small, 9, 0.0) == pytest.approx(2e-3)
    assert learning_rate(small, 500, 0.5) == pytest.approx(math.sqrt(2e-3 * 2e-4))
    line = dataclasses.replace(small, decay="linear")
    assert learning_rate(line, 0, 0.0) == pytest.approx(2e-4)
    assert learning_rate(line, 500, 0.5) == pytest.approx(1.1e-3)
    assert learning_rate(line, 999, 1.0) == pytest.approx(2e-4)


def test_a_run_may_start_from_another_runs_weights(store: PatchStore, tmp_path: Path) -> None:
    train(TINY, store, tmp_path / "first", device="cpu")
    frozen = dataclasses.replace(TINY, steps=1, schedule=ScheduleConfig(first=1e-30, last=1e-30, decay_steps=None))
    summary = train(frozen, store, tmp_path / "second", device="cpu", init=tmp_path / "first")
    theirs, ours = (load_model(tmp_path / name).state_dict() for name in ("first", "second"))
    assert all(torch.equal(theirs[name], ours[name]) for name in theirs)
    description = describe_model(tmp_path / "second")
    assert summary.starts_from == description.provenance["starts_from"]
    assert describe_model(tmp_path / "first").sha256[:16] in summary.starts_from

    wider = dataclasses.replace(TINY, model=dataclasses.replace(TINY.model, width=48))
    with pytest.raises(InputError, match=r"differs from the recipe's in \['width'\]"):
        train(wider, store, tmp_path / "third", device="cpu", init=tmp_path / "first")


def test_bfloat16_learns_what_float32_learns(store: PatchStore, tmp_path: Path) -> None:
    """The same 120 steps gain at least 1 dB in both formats and end within half a decibel of each other."""
    psnr = {}
    for precision in ("float32", "bfloat16"):
        config = dataclasses.replace(TINY, steps=120, precision=precision)
        summary = train(config, store, tmp_path / precision, device="cpu")
        assert summary.precision == precision
        curve = [row["psnr"] for row in read_log(tmp_path / precision / "log.jsonl")]
        psnr[precision] = sum(curve[-10:]) / 10
        assert psnr[precision] > sum(curve[:5]) / 5 + 1.0
    assert abs(psnr["float32"] - psnr["bfloat16"]) < 0.5, psnr


def test_a_flipped_bit_in_the_state_is_found(store: PatchStore, tmp_path: Path) -> None:
    """The optimiser's numbers: a run going on from wrong ones would look well."""
    train(TINY, store, tmp_path, device="cpu")
    path = tmp_path / "training.safetensors"
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match="sha256 is not the one written with it"):
        train(dataclasses.replace(TINY, steps=20), store, tmp_path, device="cpu", resume=True)


def test_a_log_broken_in_the_middle_is_named_and_a_cut_end_is_not(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    path.write_bytes(b'{"step": 1}\n{"step": 2}\n{"st')
    assert [row["step"] for row in read_log(path)] == [1, 2]
    for line in (b"\xff\xfe", b"[1]", b'{"step": "two"}', b"{"):
        path.write_bytes(b'{"step": 1}\n' + line + b'\n{"step": 3}\n')
        with pytest.raises(InputError, match="line 2"):
            read_log(path)
