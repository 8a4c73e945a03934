from pathlib import Path

from carstudio.demo import DemoConfig, run_demo
from carstudio.evaluation.results import read_rows


def test_a_tiny_demo_goes_the_whole_path_and_is_not_repeated(tmp_path: Path) -> None:
    config = DemoConfig(out=tmp_path / "demo", cars=4, views=2, minutes=0.01, device="cpu")
    figures = run_demo(config)
    assert figures["steps"] >= 1
    assert len(read_rows(config.out / "novel-view.jsonl")) == 2
    assert (config.out / "index.html").stat().st_size > 10_000
    weights = (config.run / "model.safetensors").read_bytes()
    assert run_demo(config) == figures
    assert (config.run / "model.safetensors").read_bytes() == weights
