"""Knowledge flows one way: geometry knows nothing of ours, the command line knows everything.

Walks the imports of src/carstudio and fails on an upward arrow, and on habits the house style rules out.
"""

import ast
from pathlib import Path

import pytest

# What everybody may know: they know only each other, from left to right.
BASE = {"devices", "errors", "files", "hub", "images", "locks", "progress", "signals", "tensors"}
FIELD = {"geometry", "rendering", "models"}
DATA = {"geometry", "perception", "synthetic", "dataset"}
# Unit (package or module of carstudio) -> the units it may import. A new unit is entered here, below what it uses.
MAY_IMPORT = {
    "errors": set(),
    "progress": set(),
    "signals": set(),
    "allocator": set(),
    "devices": {"errors"},
    "files": {"errors"},
    "hub": set(),
    "locks": {"errors", "files"},
    "images": {"errors", "files"},
    "tensors": {"errors", "files"},
    "geometry": set(),
    "rendering": {"geometry"},
    "models": {"geometry", "rendering"} | BASE,
    "perception": {"geometry"} | BASE,
    "synthetic": {"geometry"} | BASE,
    "dataset": DATA - {"dataset"} | BASE,
    "fitting": FIELD | BASE,
    "training": FIELD | DATA | BASE | {"fitting"},
    "evaluation": FIELD | DATA | BASE | {"fitting", "training"},
    "scene": FIELD | DATA | BASE | {"fitting", "training", "evaluation", "report"},
    "lift": FIELD | DATA | BASE | {"fitting", "training", "evaluation"},
    "review": DATA | BASE,
    "report": FIELD | DATA | BASE | {"fitting", "training", "evaluation"},
    "export": FIELD | DATA | BASE | {"fitting", "training", "evaluation", "scene", "lift", "report"},
    "viewer": FIELD | DATA | BASE | {"fitting", "training", "evaluation", "scene", "lift", "report", "export"},
    "recipes": FIELD | {"errors", "training"},
    "comparison": FIELD | DATA | BASE | {"fitting", "training", "evaluation", "report", "recipes"},
}
DOORS = {"__main__", "cli", "commands", "demo"}  # may import everything; nobody imports them
PICKLERS = {"pickle", "dill", "cloudpickle", "shelve", "joblib"}
VAGUE_NAMES = {"utils.py", "util.py", "helpers.py", "common.py", "misc.py"}


def unit_of(path: Path, package: Path) -> str:
    return path.relative_to(package).parts[0].removesuffix(".py")


def imported_units(path: Path, package: Path) -> set[str]:
    """Units of carstudio that a file imports, anywhere in it: inside functions too."""
    units: set[str] = set()
    here = ("carstudio", *path.relative_to(package).parts[:-1])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(here[: len(here) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            names = [f"{module}.{alias.name}" for alias in node.names]
        parts = [name.split(".") for name in names]
        units |= {p[1] for p in parts if p[0] == "carstudio" and len(p) > 1 and p[1] != "__version__"}
    return units


def upward_arrows(package: Path) -> list[str]:
    arrows = []
    for path in sorted(package.rglob("*.py")):
        unit = unit_of(path, package)
        if unit in DOORS | {"__init__"}:
            continue
        if unit not in MAY_IMPORT:
            arrows.append(f"{unit}: a new unit; enter it in MAY_IMPORT with what it may know")
            continue
        forbidden = imported_units(path, package) - MAY_IMPORT[unit] - {unit}
        arrows += [f"{path.relative_to(package)} imports carstudio.{name}" for name in sorted(forbidden)]
    return arrows


def calls(tree: ast.AST) -> list[tuple[str, ast.Call]]:
    """(dotted name, node) of every call whose function is a plain name or attribute chain."""
    return [(ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]


def bad_habits(package: Path) -> list[str]:
    found = []
    for path in sorted(package.rglob("*.py")):
        tree, name = ast.parse(path.read_text(encoding="utf-8")), str(path.relative_to(package))
        if path.name in VAGUE_NAMES:
            found.append(f"{name}: say what it holds")
        if path.name == "__init__.py" and not ast.get_docstring(tree):
            found.append(f"{name}: a package says in a docstring what it is about")
        imports = {a.name.split(".")[0] for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
        imports |= {(n.module or "").split(".")[0] for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        found += [f"{name}: imports {module}" for module in sorted(imports & PICKLERS)]
        for function, node in calls(tree):
            keywords = {k.arg: ast.unparse(k.value) for k in node.keywords}
            if function == "torch.load" and keywords.get("weights_only") != "True":
                found.append(f"{name}:{node.lineno}: torch.load without weights_only=True")
            if function == "print" and unit_of(path, package) != "cli":
                found.append(f"{name}:{node.lineno}: print outside the command line")
            if keywords.get("shell") == "True" or function == "os.system":
                found.append(f"{name}:{node.lineno}: a command as a shell string")
            if keywords.get("allow_pickle") == "True":
                found.append(f"{name}:{node.lineno}: unpickles numpy files")
    return found


@pytest.fixture
def package(repo_root: Path) -> Path:
    return repo_root / "src" / "carstudio"


def test_no_arrow_points_upward(package):
    assert upward_arrows(package) == []


def test_the_table_itself_has_no_circle():
    known: set[str] = set()
    rest = dict(MAY_IMPORT)
    while rest:
        free = {unit for unit, below in rest.items() if below <= known}
        assert free, f"these import each other in a circle: {sorted(rest)}"
        known |= free
        rest = {unit: below for unit, below in rest.items() if unit not in free}


def test_house_style_holds(package):
    assert bad_habits(package) == []


def made_up(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("geometry/x.py", "from carstudio.rendering.volume import composite"),
        ("geometry/x.py", "import carstudio.errors"),
        ("rendering/x.py", "def f():\n    from carstudio.models import car_nerf"),
        ("dataset/sources/x.py", "from ...training import trainer"),
        ("training/x.py", "from carstudio import evaluation"),
        ("report/x.py", "from carstudio.cli import main"),
        ("files.py", "from carstudio.images import read_image"),
        ("novelty/x.py", "X = 1"),
    ],
)
def test_a_made_up_upward_arrow_is_seen(tmp_path, name, text):
    assert len(upward_arrows(made_up(tmp_path, {name: text}))) == 1


def test_allowed_arrows_pass(tmp_path):
    files = {
        "models/x.py": "from carstudio.rendering.volume import composite\nfrom . import interface",
        "dataset/x.py": "from carstudio import __version__\nfrom carstudio.errors import InputError",
        "cli.py": "from carstudio.commands import demo",
    }
    assert upward_arrows(made_up(tmp_path, files)) == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("models/utils.py", "X = 1"),
        ("models/x.py", "import pickle"),
        ("models/x.py", "torch.load(path)"),
        ("models/x.py", "torch.load(path, weights_only=False)"),
        ("models/x.py", "print('debug here')"),
        ("models/x.py", "subprocess.run(command, shell=True)"),
        ("models/__init__.py", ""),
    ],
)
def test_a_made_up_bad_habit_is_seen(tmp_path, name, text):
    assert len(bad_habits(made_up(tmp_path, {name: text}))) == 1
