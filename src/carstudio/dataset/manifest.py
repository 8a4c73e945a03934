"""A store's `manifest.json`: format version, counts, checksums; nothing about when or where it was made."""

import hashlib
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from carstudio.errors import InputError
from carstudio.files import read_json, write_json

FORMAT = "carpatch3d"
FORMAT_VERSION = 1
_SHARD_NAME = re.compile(r"[\w.-]+")


@dataclass(frozen=True)
class Shard:
    """One file of `data/`."""

    name: str
    num_patches: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """`shards` are those of the last finished write; an unfinished store may hold more."""

    sources: tuple[str, ...]
    shards: tuple[Shard, ...] = ()
    is_finished: bool = False
    resume_key: str | None = None  # of an unfinished write: goes on only with the same key
    format_version: int = FORMAT_VERSION

    @property
    def num_patches(self) -> int:
        """Candidates in the listed shards, kept or not."""
        return sum(shard.num_patches for shard in self.shards)


def data_sha256(checksums: Iterable[tuple[str, str]]) -> str:
    """One checksum for all shards: sha256 over lines `<sha256>  <name>`, as `sha256sum` prints them in name order."""
    lines = "".join(f"{sha256}  {name}\n" for name, sha256 in sorted(checksums))
    return hashlib.sha256(lines.encode()).hexdigest()


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write `manifest.json`, atomically."""
    shards = [asdict(shard) for shard in manifest.shards]
    content = {
        "format": FORMAT,
        "format_version": manifest.format_version,
        "is_finished": manifest.is_finished,
        "resume_key": manifest.resume_key,
        "sources": list(manifest.sources),
        "num_patches": manifest.num_patches,
        "shards": shards,
        "data_sha256": data_sha256((shard.name, shard.sha256) for shard in manifest.shards),
    }
    write_json(folder / "manifest.json", content)


def read_manifest(folder: Path) -> Manifest:
    """The manifest; `InputError` when the folder is no CarPatch3D store or one of a later format."""
    path = folder / "manifest.json"
    if not path.is_file():
        raise InputError(
            f"{folder}: no CarPatch3D store (no manifest.json); make one with `carstudio build` or `synth`"
        )
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'{path}: expected "format": "{FORMAT}", found another kind of manifest; choose a store')
    version = content.get("format_version")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise InputError(
            f"{path}: format version {version}, this program reads up to {FORMAT_VERSION}; update carstudio"
        )
    try:
        return _manifest_from_json(content)
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: broken manifest ({error!r}); rebuild the store or restore the file") from error


def is_finished_store(folder: Path) -> bool:
    """Whether a store is there whose writing was not interrupted."""
    try:
        return read_manifest(folder).is_finished
    except InputError:
        return False


def _shard_from_json(value: dict[str, Any]) -> Shard:
    name, count, checksum = value.get("name"), value.get("num_patches"), value.get("sha256")
    if not (isinstance(name, str) and _SHARD_NAME.fullmatch(name) and isinstance(checksum, str)):
        raise TypeError(f"shard {value!r}: expected the name of a file in data/ and its sha256")
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise TypeError(f"shard {name}: num_patches must be 0 or more, found {count!r}")
    return Shard(**value)


def _manifest_from_json(content: dict[str, Any]) -> Manifest:
    return Manifest(
        sources=tuple(str(source) for source in content["sources"]),
        shards=tuple(_shard_from_json(shard) for shard in content["shards"]),
        is_finished=bool(content["is_finished"]),
        resume_key=content.get("resume_key"),
        format_version=content["format_version"],
    )
