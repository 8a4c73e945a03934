"""Fetch a model of the hub: into its cache, or into a folder to carry to a machine without a network."""

import inspect
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from carstudio.errors import InputError, StorageError, first_line
from carstudio.files import make_folder
from carstudio.hub import hub_answers
from carstudio.progress import Report, silent

_SETTINGS = ("config.json", "preprocessor_config.json", "processor_config.json")
_WEIGHTS = ("model.safetensors", "model.safetensors.index.json", "pytorch_model.bin")  # the first that is there
_MEGABYTE = 1_000_000


@dataclass(frozen=True)
class Downloaded:
    """What was fetched and where it lies."""

    name: str
    folder: Path
    files: tuple[str, ...]
    num_bytes: int


def download(name: str, out: Path | None = None, report: Report = silent) -> Downloaded:
    """Fetch settings and weights, no other formats; `InputError` when the hub or the model cannot be had.

    A download that was interrupted goes on where it was; what is here already is not fetched again.
    """
    from huggingface_hub import constants

    if not hub_answers():
        raise InputError(
            f"{name}: {constants.ENDPOINT} does not answer, so nothing can be downloaded"
            + (" (HF_HUB_OFFLINE is set)" if constants.HF_HUB_OFFLINE else "")
            + f"; run `carstudio models download {name} --out FOLDER` on a machine with a network and carry FOLDER "
            "here, or set HTTPS_PROXY, or HF_ENDPOINT to a mirror"
        )
    revision, sizes = _files(name)
    place = Path(constants.HF_HUB_CACHE) if out is None else out
    make_folder(place)
    total = sum(sizes.values())
    free = shutil.disk_usage(place).free
    if free < total:
        raise StorageError(place, f"{name} takes {total / 1e9:.1f} GB, {free / 1e9:.1f} GB are free")
    done = 0
    for file, size in sizes.items():
        path = _fetch(name, file, revision=revision, out=out, report=_counter(report, name, done, total))
        done += size
        report(name, done // _MEGABYTE, max(1, total // _MEGABYTE), "MB")
    if out is not None:
        shutil.rmtree(out / ".cache", ignore_errors=True)  # what the hub's client notes to resume
    return Downloaded(name, out or path.parent, tuple(sizes), total)


def _files(name: str) -> tuple[str, dict[str, int]]:
    """(commit, bytes of each file to fetch)."""
    from huggingface_hub import HfApi, constants
    from huggingface_hub.errors import GatedRepoError, HfHubHTTPError, HFValidationError, RepositoryNotFoundError

    try:
        info = HfApi().model_info(name, files_metadata=True)
    except GatedRepoError as error:
        raise InputError(
            f"{name}: its owner wants you to agree to the licence first; do so at {constants.ENDPOINT}/{name}, "
            "then run `hf auth login`"
        ) from error
    except (RepositoryNotFoundError, HFValidationError) as error:
        raise InputError(
            f"{name}: no such model on {constants.ENDPOINT}; `carstudio models list` shows those we know, expected "
            "OWNER/MODEL"
        ) from error
    except (HfHubHTTPError, OSError) as error:
        raise InputError(f"{name}: the hub refuses ({first_line(error)}); try again later") from error
    sizes = {file.rfilename: file.size or 0 for file in info.siblings or []}
    return info.sha or "main", {file: sizes[file] for file in _wanted(name, list(sizes))}


def _wanted(name: str, files: list[str]) -> list[str]:
    weights = [file for file in _WEIGHTS if file in files][:1]
    if "config.json" not in files or not weights:
        raise InputError(
            f"{name}: expected a model as save_pretrained writes it (config.json and model.safetensors), found "
            f"{', '.join(files[:8]) or 'nothing'}; choose one whose page on the hub says `transformers`"
        )
    if weights[0].endswith(".index.json"):
        weights += [file for file in files if file.startswith("model-") and file.endswith(".safetensors")]
    return [file for file in _SETTINGS if file in files] + weights


def _fetch(name: str, file: str, *, revision: str, out: Path | None, report: Any) -> Path:
    from huggingface_hub import constants, hf_hub_download

    # Of the clients that transformers 5 works with, the older ones cannot be given a bar: then it moves file by file.
    bar = {"tqdm_class": report} if "tqdm_class" in inspect.signature(hf_hub_download).parameters else {}
    # The commit only where it does not change what the cache knows as "main".
    place: dict[str, Any] = {} if out is None else {"local_dir": out, "revision": revision}
    try:
        return Path(hf_hub_download(name, file, **place, **bar))
    except Exception as error:  # whatever the HTTP client raises
        if isinstance(error, OSError) and error.errno is not None:
            raise StorageError(out or constants.HF_HUB_CACHE, error.strerror) from error
        raise InputError(
            f"{name}: {file} stopped in the middle ({type(error).__name__}: {str(error)[:200]}); the same command "
            "goes on where it was"
        ) from error


def _counter(report: Report, name: str, before: int, total: int) -> type:
    """A bar for the hub's client that hands on its bytes to `report`."""
    from huggingface_hub.utils import tqdm

    class Counter(tqdm):  # type: ignore[misc,type-arg]  # the client's class is untyped
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **{**kwargs, "disable": True})
            self.bytes = 0

        def update(self, n: Any = 1) -> None:
            self.bytes += int(n or 0)
            report(name, (before + self.bytes) // _MEGABYTE, max(1, total // _MEGABYTE), "MB")

    return Counter
