"""Nothing that is loaded may run: no unpickling, no evaluation of text, no shell; what files say is shown as text."""

import ast
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

from carstudio.dataset.store import open_store
from carstudio.errors import InputError
from carstudio.evaluation.tables import Cell, Table, to_html
from carstudio.images import read_image
from carstudio.perception.specs import make_segmenter
from carstudio.report.page import Commands, Page, Section, Text, render_page
from carstudio.tensors import load_tensors
from carstudio.training.checkpoint import load_model
from carstudio.training.resume import load_state

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for folder in ("src", "bench", "tools", "examples") for path in (ROOT / folder).rglob("*.py"))
FORBIDDEN_MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}
FORBIDDEN_CALLS = {"eval", "exec", "os.system", "os.popen", "yaml.load", "yaml.unsafe_load", "pd.read_pickle"}


def dotted(node: ast.expr) -> str:
    """`a.b.c` of a name or attribute, "" of anything else."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def keyword(call: ast.Call, name: str) -> object:
    """The literal value of a keyword argument; None when it is absent or computed."""
    found = [item.value for item in call.keywords if item.arg == name]
    return found[0].value if found and isinstance(found[0], ast.Constant) else None


def offences(source: str) -> Iterator[str]:
    """What in a source file could run something that was only to be read."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            yield from (f"line {node.lineno}: imports {name}" for name in names if name in FORBIDDEN_MODULES)
        if isinstance(node, ast.Call):
            name = dotted(node.func)
            if name in FORBIDDEN_CALLS or name.endswith(".load_pickle"):
                yield f"line {node.lineno}: calls {name}"
            if name == "torch.load" and keyword(node, "weights_only") is not True:
                yield f"line {node.lineno}: torch.load without weights_only=True"
            if name in ("np.load", "numpy.load") and keyword(node, "allow_pickle"):
                yield f"line {node.lineno}: {name} with allow_pickle"
            if keyword(node, "shell"):
                yield f"line {node.lineno}: {name} with shell"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_source_runs_what_it_reads(path: Path) -> None:
    assert list(offences(path.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from dill import loads",
        "eval(text)",
        "os.system('ls ' + name)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path, allow_pickle=True)",
        "subprocess.run(line, shell=True)",
    ],
)
def test_the_search_finds_what_it_looks_for(source: str) -> None:
    assert list(offences(source))


class Bomb:
    """Unpickled, it makes the file it was given."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[Path]]:
        return Path.touch, (self.path,)


def plant(path: Path, witness: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(Bomb(witness)))


def test_a_pickle_in_disguise_is_refused_and_does_not_run(tmp_path: Path) -> None:
    witness = tmp_path / "ran"
    plant(tmp_path / "run" / "model.safetensors", witness)
    plant(tmp_path / "run" / "training.safetensors", witness)
    plant(tmp_path / "run" / "model.json", witness)
    plant(tmp_path / "store" / "manifest.json", witness)
    plant(tmp_path / "net.onnx", witness)
    plant(tmp_path / "photo.png", witness)
    for read in (
        lambda: load_tensors(tmp_path / "run" / "model.safetensors"),
        lambda: load_state(tmp_path / "run"),
        lambda: load_model(tmp_path / "run"),
        lambda: open_store(tmp_path / "store"),
        lambda: read_image(tmp_path / "photo.png"),
    ):
        with pytest.raises(InputError):
            read()
    pytest.importorskip("onnxruntime", reason="the onnx extra is not installed")
    with pytest.raises(InputError, match=r"net\.onnx"):
        make_segmenter(f"onnx:{tmp_path / 'net.onnx'}")
    assert not witness.exists()
    pickle.loads((tmp_path / "photo.png").read_bytes())  # the bomb itself works
    assert witness.exists()


def test_pages_show_names_from_files_as_text() -> None:
    name = "<script>alert(1)</script>"
    page = Page(
        title=name,
        lead=name,
        sections=[Section(title=name, blocks=[Text(name), Commands([name])])],
        footer=[("car", name)],
    )
    table = to_html(Table(name, (name,), ((Cell(name),),), (name,)))
    for shown in (render_page(page, Path()), table):
        assert "<script>alert" not in shown
        assert "&lt;script&gt;alert" in shown
