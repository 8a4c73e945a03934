"""`carstudio doctor`: what is installed and present, what each missing thing is for, and how to get it."""

import platform
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from carstudio import __version__
from carstudio.commands.command import Outcome, Output, plain
from carstudio.commands.models import known_models
from carstudio.commands.tables import table
from carstudio.errors import InputError

EXTRAS = {
    "onnx": "detectors and segmenters in ONNX files (--detector onnx:FILE, --segmenter onnx:FILE)",
    "fuzz": "coverage-guided fuzzing of the readers, for developers (./run fuzz --engine atheris)",
    "photo": "path-traced synthetic photographs (synth --renderer mitsuba)",
    "track": "training curves in TensorBoard",
    "lpips": "the LPIPS figure of evaluate",
    "dev": "tests, lint and type checks",
}
"""What each extra of pyproject.toml is for."""
_LITTLE_DISK_GB = 5.0  # SAM ViT-H and a store of some thousand patches


@dataclass(frozen=True)
class Package:
    """A distribution that the core (`extra` None) or an extra asks for."""

    name: str
    extra: str | None
    wanted: str
    """Version specifier, such as >=2.6."""
    version: str | None
    """What is installed; None: nothing."""
    is_right: bool
    """Installed, in a version that was asked for."""


@dataclass(frozen=True, kw_only=True)
class Doctor(Output):
    """Say what is installed, which pretrained networks are here, what is missing and how to get it."""

    out: Path = Path()
    """A place where outputs will go, to see its free disk."""

    def run(self) -> Outcome:
        """Look around; `InputError` with the same report when the core itself cannot work."""
        packages, torch = installed_packages(), torch_abilities()
        found = {
            "carstudio": __version__,
            "python": platform.python_version(),
            "system": f"{platform.system()} {platform.machine()}",
            "torch": torch,
            "packages": plain(packages),
            "models": known_models(),
            "disk": free_disk(self.out),
            "problems": problems(packages, torch),
        }
        text = report(found, packages)
        if found["problems"]:
            raise InputError(text)
        return Outcome(text, found)


def installed_packages() -> list[Package]:
    """What the metadata of this installation asks for, and what is there; without the project itself."""
    try:
        about = metadata.metadata("carstudio")
    except metadata.PackageNotFoundError:  # run from a checkout that is not installed
        return []
    extras = about.get_all("Provides-Extra") or []
    return parse_requirements(about.get_all("Requires-Dist") or [], extras)


def parse_requirements(lines: Sequence[str], extras: Sequence[str]) -> list[Package]:
    """Requirements of a distribution's metadata (`onnxruntime>=1.17; extra == "onnx"`), the core's first."""
    packages = []
    for requirement in map(Requirement, lines):
        marker = requirement.marker
        if requirement.name == "carstudio":
            continue
        for extra in (None,) if marker is None or marker.evaluate({"extra": ""}) else tuple(extras):
            if marker is None or extra is None or marker.evaluate({"extra": extra}):
                packages.append(_look_up(requirement, extra))
    return packages


def _look_up(requirement: Requirement, extra: str | None) -> Package:
    try:
        version = metadata.version(requirement.name)
    except metadata.PackageNotFoundError:
        return Package(requirement.name, extra, str(requirement.specifier), None, is_right=False)
    is_right = requirement.specifier.contains(version, prereleases=True)
    return Package(requirement.name, extra, str(requirement.specifier), version, is_right)


def torch_abilities() -> dict[str, Any]:
    """Version, devices and threads of PyTorch; `error` when it does not work."""
    try:
        import torch

        torch.ones(2, 2) @ torch.ones(2, 2)
    except Exception as error:  # a broken installation raises anything
        return {"error": f"{type(error).__name__}: {error}"}
    devices = ["cpu"]
    for index in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(index)
        devices.append(f"cuda:{index} ({properties.name}, {properties.total_memory / 1e9:.0f} GB)")
    if torch.backends.mps.is_available():
        devices.append("mps")
    return {"version": torch.__version__, "devices": devices, "threads": torch.get_num_threads()}


def free_disk(out: Path) -> list[dict[str, Any]]:
    """Free 10^9 bytes where models, outputs and temporary files go."""
    from huggingface_hub import constants

    places = {
        "models (HF_HOME)": Path(constants.HF_HUB_CACHE),
        "outputs": out.absolute(),
        "temporary (TMPDIR)": Path(tempfile.gettempdir()),
    }
    disks = []
    for what, folder in places.items():
        there = next(parent for parent in (folder, *folder.parents) if parent.exists())
        disks.append({"what": what, "folder": str(folder), "free_gb": round(shutil.disk_usage(there).free / 1e9, 1)})
    return disks


def problems(packages: Sequence[Package], torch: dict[str, Any]) -> list[str]:
    """What the core cannot work without."""
    found = [
        f"{p.name}{p.wanted} is needed, {p.version or 'none'} is installed: pip install '{p.name}{p.wanted}'"
        for p in packages
        if p.extra is None and not p.is_right
    ]
    if "error" in torch:
        found.append(f"torch does not work ({torch['error']}): install it again, https://pytorch.org/get-started")
    return found


def report(found: dict[str, Any], packages: Sequence[Package]) -> str:
    """The findings as tables, what is missing last."""
    torch, broken = found["torch"], found["problems"]
    about = torch.get("error") or f"{torch['version']}: {', '.join(torch['devices'])}; {torch['threads']} threads"
    models = [
        (m["name"], "yes" if m["is_here"] else "no", f"{m['megabytes']} MB", m["purpose"]) for m in found["models"]
    ]
    disks = [(d["what"], _gigabytes(d["free_gb"]), d["folder"]) for d in found["disk"]]
    core = [package for package in packages if package.extra is None]
    parts = [
        f"carstudio {found['carstudio']}, Python {found['python']}, {found['system']}",
        f"torch {about}",
        f"core: {sum(p.is_right for p in core)} of {len(core)} packages",
        "",
        table(("extra", "packages", "for"), extra_rows(packages)),
        "",
        table(("model", "here", "download", "for"), models),
        "get one with: carstudio models download NAME",
        "",
        table(("disk", "free", "folder"), disks),
        "",
    ]
    for extra in dict.fromkeys(p.extra for p in packages if p.extra is not None and not p.is_right):
        parts.append(f"for {EXTRAS.get(extra, extra)}: pip install 'carstudio[{extra}]' or ./run setup {extra}")
    parts += [f"BROKEN: {problem}" for problem in broken] or ["the core is whole"]
    return "\n".join(parts)


def extra_rows(packages: Sequence[Package]) -> list[tuple[str, str, str]]:
    """One row per extra: its packages with what is installed of each."""
    rows = []
    for extra in dict.fromkeys(package.extra for package in packages if package.extra is not None):
        members = [p for p in packages if p.extra == extra]
        there = ", ".join(f"{p.name} {p.version or 'missing'}" for p in members)
        rows.append((extra, there, EXTRAS.get(extra, "")))
    return rows


def _gigabytes(free: float) -> str:
    return f"{free} GB" + (" (little)" if free < _LITTLE_DISK_GB else "")
