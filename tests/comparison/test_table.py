"""The paper's tables end to end on toy cars: rows resumed one by one, three files that say the same."""

import html.parser
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

import carstudio.comparison.running as running
from carstudio.cli import run
from carstudio.comparison.budgets import BUDGETS, Budget, FieldSize, within
from carstudio.comparison.document import paper_columns
from carstudio.comparison.paper_figures import MULTI_VIEW, ZERO_SHOT
from carstudio.comparison.rows import ROWS, Row, chosen, multi_view_rows, zero_shot_rows
from carstudio.comparison.running import Work
from carstudio.comparison.scaling import counts_for, make_scaling, scaling_rows
from carstudio.comparison.table import make_table
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.evaluation.results import read_rows
from carstudio.models.car_gaussians import CarGaussiansConfig
from carstudio.training.config import TrainConfig
from training.toy import TINY, toy_store

TINIEST = Budget(
    name="smoke",
    steps=2,
    size=FieldSize(encoder_side_px=16, width=16, code_size=8, samples=4, patches_per_step=2, rays_per_patch=16),
    scored=3,
)
NAMES = ("pixelnerf-mlp", "car-nerf", "code-nerf")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store", cars=12, views=4)


def work(store: PatchStore, out: Path, split: str = "instance") -> Work:
    return Work(store=store, out=out, split=split, limit=3, device="cpu", command="carstudio table ...")


@pytest.fixture(scope="module")
def table(store: PatchStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("table")
    make_table("zero-shot", work(store, out), chosen(zero_shot_rows(), NAMES), TINIEST)
    return out


def markdown_tables(text: str) -> list[list[list[str]]]:
    """Cells of every table: plain text with `!` after the best and `?` after the second best."""
    tables: list[list[list[str]]] = []
    for block in text.split("\n\n"):
        lines = [line for line in block.splitlines() if line.startswith("|")]
        if lines:
            cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if "---" not in line]
            tables.append([[marked(cell, r"\*\*(.*?)\*\*", r"\*(.*?)\*") for cell in row] for row in cells])
    return tables


def latex_tables(text: str) -> list[list[list[str]]]:
    tables = []
    for body in re.findall(r"\\toprule(.*?)\\bottomrule", text, re.S):
        lines = [line.removesuffix(r"\\").strip() for line in body.splitlines() if "&" in line]
        rows = [[cell.strip() for cell in line.split(" & ")] for line in lines]
        tables.append([[latex_cell(cell) for cell in row] for row in rows])
    return tables


def latex_cell(cell: str) -> str:
    cell = re.sub(r"\{\\scriptsize (.*?)\}", r"\1", cell)
    cell = marked(cell, r"\\textbf\{(.*?)\}", r"\\underline\{(.*?)\}")
    return cell.replace(r"$\uparrow$", "↑").replace(r"$\downarrow$", "↓").replace("--", "–").replace("\\", "")


def marked(cell: str, best: str, second: str) -> str:
    return re.sub(second, r"\1?", re.sub(best, r"\1!", cell))


class Cells(html.parser.HTMLParser):
    """Rows of `<table class="results">`."""

    def __init__(self) -> None:
        super().__init__()
        self.tables: list[list[list[str]]] = []
        self.depth = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
            self.depth = tag

    def handle_endtag(self, tag: str) -> None:
        if tag in ("strong", "em") and self.depth:
            self.tables[-1][-1][-1] += "!" if tag == "strong" else "?"
        if tag in ("td", "th"):
            self.depth = ""

    def handle_data(self, data: str) -> None:
        if self.depth:
            self.tables[-1][-1][-1] += data


def test_markdown_latex_and_html_say_the_same(table: Path) -> None:
    parser = Cells()
    parser.feed((table / "zero-shot.html").read_text())
    markdown = markdown_tables((table / "zero-shot.md").read_text())
    assert len(markdown) == 2, "both protocols"
    assert len(markdown[0]) == 4, "a head and three rows"
    assert any("!" in cell for row in markdown[0] for cell in row)
    assert markdown == latex_tables((table / "zero-shot.tex").read_text())
    assert markdown == parser.tables


def test_figures_are_the_means_of_the_rows_and_marks_follow_them(table: Path) -> None:
    rows = read_rows(table / "rows.jsonl")
    assert {row.protocol for row in rows} == {"novel-view", "input-view"}
    assert {row.split for row in rows} == {"instance:test"}
    model = running.read_json(table / "runs" / "code-nerf" / "model.json")
    trained = set(model["config"]["cars"])
    assert trained
    assert not trained & {row.instance_id for row in rows}, "zero-shot: no car was seen"
    head, *body = markdown_tables((table / "zero-shot.md").read_text())[0]
    by_name = {row.name: row for row in zero_shot_rows()}
    for column, key in (("PSNR (dB) ↑", "psnr"), ("SSIM (car) ↑", "ssim_mask"), ("Mask IoU ↑", "mask_iou")):
        place = head.index(column)
        means = {}
        for name in NAMES:
            values = [getattr(row, key) for row in rows if row.method == name and row.protocol == "novel-view"]
            means[by_name[name].title] = sum(values) / len(values)
        digits = 2 if key == "psnr" else 4
        ranked = sorted({round(mean, digits) for mean in means.values()}, reverse=True)
        for row in body:
            mark = {0: "!", 1: "?"}.get(ranked.index(round(means[row[0]], digits)), "")
            assert row[place].startswith(f"{means[row[0]]:.{digits}f}{mark}"), (column, row[0])


def test_the_papers_figures_and_marks_are_the_papers() -> None:
    """Table II: PSNR best w/o mask, SSIM and LPIPS best with, second best in blue. Table III: single-view leads."""
    _, columns, note = paper_columns([ZERO_SHOT.get(row.name) for row in zero_shot_rows() if row.is_default])
    assert "3,072" in note
    marks = [[cell.mark for cell in column] for column in columns]
    assert marks[0] == ["", "", "second", "best", "", ""]
    assert marks[1] == ["", "", "", "second", "best", ""]
    assert marks[2] == ["", "", "", "second", "best", ""]
    assert [cell.text for cell in columns[0]] == ["11.61", "17.87", "20.75", "20.93", "20.23", "–"]
    _, columns, _ = paper_columns([MULTI_VIEW.get(row.name) for row in multi_view_rows()])
    assert all(column[4].mark == "best" for column in columns)
    assert [cell.text for cell in columns[2]][:5] == ["0.4343", "0.3852", "0.3299", "0.4075", "0.2825"]


def test_the_header_names_budget_data_split_seed_and_cost(table: Path) -> None:
    for ending in ("md", "tex", "html"):
        text = (table / f"zero-shot.{ending}").read_text()
        for what in ("2 steps", "fields 16 wide", "sha256", "instance:", "seed: 0", "CPU-seconds of training in all"):
            assert what in text, (ending, what)
    assert (table / "zero-shot.png").exists()


class KilledError(Exception):
    """Stands for SIGKILL."""


def test_a_killed_table_goes_on_row_by_row(
    store: PatchStore, table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after two rows' training, before the second is scored: nothing finished is done again, ends are equal."""
    real_train, real_score = running.train, running.score_run
    trained: list[str] = []
    scored: list[str] = []

    def train(config: object, *arguments: object, **options: object) -> object:
        trained.append(config.recipe)  # type: ignore[attr-defined]
        return real_train(config, *arguments, **options)  # type: ignore[arg-type]

    def score(model: object, description: object, *rest: object, **options: object) -> object:
        scored.append(description.provenance["recipe"])  # type: ignore[attr-defined]
        if len(scored) == 3:
            raise KilledError
        return real_score(model, description, *rest, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(running, "train", train)
    monkeypatch.setattr(running, "score_run", score)
    rows = chosen(zero_shot_rows(), NAMES)
    with pytest.raises(KilledError):
        make_table("zero-shot", work(store, tmp_path), rows, TINIEST)
    assert not (tmp_path / "zero-shot.md").exists()
    make_table("zero-shot", work(store, tmp_path), rows, TINIEST)
    names = [row.name for row in rows]
    assert trained == names
    assert scored == [names[0]] * 2 + [names[1]] * 3 + [names[2]] * 2
    for name in ("rows.jsonl", "zero-shot.png"):
        assert (tmp_path / name).read_bytes() == (table / name).read_bytes(), name


def test_a_row_of_other_settings_is_not_mixed_in(store: PatchStore, table: Path) -> None:
    rows = chosen(zero_shot_rows(), ("car-nerf",))
    with pytest.raises(InputError, match=r"begun with other settings \(.*training.steps 2 and not 3\)"):
        make_table("zero-shot", work(store, table), rows, replace(TINIEST, steps=3))
    with pytest.raises(InputError, match="seed"):
        make_table("zero-shot", replace(work(store, table), seed=1), rows, TINIEST)


def test_multi_view_scores_other_photos_of_cars_it_was_trained_on(store: PatchStore, tmp_path: Path) -> None:
    make_table("multi-view", work(store, tmp_path, "view"), chosen(multi_view_rows(), ("code-nerf",)), TINIEST)
    cars = running.read_json(tmp_path / "runs" / "code-nerf" / "model.json")["config"]["cars"]
    rows = read_rows(tmp_path / "rows.jsonl")
    assert {row.instance_id for row in rows} <= set(cars)
    held_out = set(store.patch_ids(split="view", part="test"))
    assert {row.patch_id for row in rows} <= held_out
    novel = [row for row in rows if row.protocol == "novel-view"]
    assert {row.input_patch_id for row in novel}.isdisjoint(held_out)


@pytest.mark.parametrize("name", ["zero-shot", "multi-view"])
def test_rows_differ_by_their_model_alone(name: str) -> None:
    """At `cpu`, what is no part of a model is equal in all radiance fields; sizes are equal where they exist."""
    for row in ROWS[name]():
        config = within(BUDGETS["cpu"], row.config)
        if isinstance(config.model, CarGaussiansConfig):
            continue
        size = BUDGETS["cpu"].size
        assert size is not None
        assert (config.patches_per_step, config.rays_per_patch) == (size.patches_per_step, size.rays_per_patch)
        assert (config.cpu_seconds, config.schedule, config.clip_gradient) == (300.0, first().schedule, 1.0)
        assert (config.model.sampling.coarse, config.model.sampling.fine, config.model.width) == (20, 0, 128)
        assert getattr(config.model, "encoder", None) in (None, first().model.encoder)  # type: ignore[union-attr]


def first() -> TrainConfig:
    return within(BUDGETS["cpu"], zero_shot_rows()[0].config)


def test_the_paper_budget_is_the_papers() -> None:
    for row in [*zero_shot_rows(), *multi_view_rows()]:
        config = within(BUDGETS["paper"], row.config)
        assert config.steps == 500_000
        if not isinstance(config.model, CarGaussiansConfig):
            assert config.patches_per_step * config.rays_per_patch == 3_072
    assert {row.config.supervision for row in zero_shot_rows()} == {"single-view"}
    assert [row.config.supervision for row in multi_view_rows()][3:5] == ["multi-view", "single-view"]


def test_small_rows_may_share_steps_instead_of_processor_seconds() -> None:
    budget = replace(BUDGETS["cpu"], steps=7, cpu_seconds=None)
    config = within(budget, zero_shot_rows()[0].config)
    assert (config.steps, config.cpu_seconds, config.minutes) == (7, None, None)
    assert config.model == first().model
    assert str(budget).startswith("cpu: 7 steps of training per row")


def test_unknown_rows_and_lengths_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="no row \\['car'\\]; there are pixelnerf-resnet"):
        chosen(zero_shot_rows(), ("car",))
    out = str(tmp_path / "out")
    for options, message in (
        (["--budget", "cpu"], "--data STORE is needed"),
        (["--budget", "smoke", "--cpu-seconds", "3"], "goes with --budget cpu"),
        (["--budget", "cpu", "--steps", "3", "--cpu-seconds", "3"], "found both"),
    ):
        assert run(["table", "zero-shot", "--out", out, *options]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("available", "expected"),
    [(10, [3, 10]), (1, [1]), (100, [100]), (110, [100]), (540, [100, 300, 540]), (3_000, [100, 300, 1_000, 3_000]),
     (9_000, [100, 300, 1_000, 3_000])],
)  # fmt: skip
def test_how_many_cars_are_trained_on(available: int, expected: list[int]) -> None:
    assert counts_for(available) == expected


def test_scaling_compares_cars_colours_and_sizes(
    store: PatchStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import carstudio.comparison.scaling as scaling

    monkeypatch.setattr(scaling, "SMOKE_PAIRS", 1)
    monkeypatch.setattr(scaling, "RECOLOUR_SIZE_PX", 24)
    rows = scaling_rows(store, "instance")
    assert [row.name for row in rows] == [
        "car-nerf-3", "car-nerf-10", "car-gaussians-3", "car-gaussians-10", "car-nerf-points-10",
    ]  # fmt: skip
    picked = [row for row in rows if row.name in ("car-nerf-10", "car-nerf-points-10")]
    tables = make_scaling(work(store, tmp_path), picked, TINIEST)
    assert [len(table.rows) for table in tables] == [2, 2, 2, 2]
    assert tables[2].caption.startswith("Recolouring 1 unseen synthetic cars")
    assert tables[3].columns[1:5] == ("PSNR full size", "PSNR 1/2", "PSNR 1/4", "PSNR 1/8")
    assert len((tmp_path / "recolouring.jsonl").read_text().splitlines()) == 2
    sizes = {row.split for row in read_rows(tmp_path / "rows.jsonl")}
    assert sizes == {"instance:test", *(f"instance:test at {size}" for size in ("full size", "1/2", "1/4", "1/8"))}
    settings = [json.loads((tmp_path / "runs" / row.name / "row.json").read_text())["training"] for row in picked]
    differ = {key for key in settings[0] if settings[0][key] != settings[1][key]}
    assert differ == {"recipe", "model"}
    one, other = (setting["model"] for setting in settings)
    assert {key for key in one if one[key] != other[key]} == {"position_encoding", "position_frequencies"}


def test_a_row_is_what_it_says() -> None:
    row = Row("tiny", "Tiny", TINY)
    assert within(BUDGETS["gpu"], row.config).steps == 20_000
    assert within(replace(BUDGETS["cpu"], cpu_seconds=7.0), row.config).cpu_seconds == 7.0
