"""A store's `manifest.json`: format version, counts, checksums; nothing about when or where it was made."""

import hashlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from carstudio.errors import InputError, shortened
from carstudio.files import read_json, write_json

FORMAT = "carpatch3d"
FORMAT_VERSION = 1
_SHARD_NAME = re.compile(r"part-[0-9]{5,9}\.parquet")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_SHARD_KEYS = {"name", "num_patches", "sha256"}


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
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise InputError(
            f"{path}: format version {version}, this program reads up to {FORMAT_VERSION}; update carstudio"
        )
    problem = next(_problems(content), None)
    if problem is not None:
        raise InputError(f"{path}: broken manifest: {problem}; restore the file or rebuild the store")
    return _manifest_from_json(content)


def is_finished_store(folder: Path) -> bool:
    """Whether a store is there whose writing was not interrupted."""
    try:
        return read_manifest(folder).is_finished
    except InputError:
        return False


def _problems(content: dict[str, Any]) -> Iterator[str]:
    """What fields hold that they must not; totals that contradict the shards show that one of them was changed."""
    version, sources, resume_key = (content.get(name) for name in ("format_version", "sources", "resume_key"))
    if not _is_count(version) or version == 0:
        yield f"format_version must be a whole number from 1 on, found {shortened(version)}"
    if not isinstance(content.get("is_finished"), bool):
        yield f"is_finished must be true or false, found {shortened(content.get('is_finished'))}"
    if not (resume_key is None or (isinstance(resume_key, str) and resume_key.isprintable())):
        yield f"resume_key must be a text or null, found {shortened(resume_key)}"
    if not isinstance(sources, list) or not all(isinstance(name, str) and name.isprintable() for name in sources):
        yield f"sources must be a list of names, found {shortened(sources)}"
    shards = content.get("shards")
    if not isinstance(shards, list):
        yield f"shards must be a list, found {shortened(shards)}"
        return
    for shard in shards:
        yield from _shard_problems(shard)
    if len({shard["name"] for shard in shards}) < len(shards):
        yield "two shards have the same name"
    total = sum(shard["num_patches"] for shard in shards)
    if content.get("num_patches") != total:
        yield f"num_patches must be {total} as its shards say, found {shortened(content.get('num_patches'))}"
    checksum = data_sha256((shard["name"], shard["sha256"]) for shard in shards)
    if content.get("data_sha256") != checksum:
        yield f"data_sha256 must be {checksum} as its shards say, found {shortened(content.get('data_sha256'))}"


def _shard_problems(shard: Any) -> Iterator[str]:
    if not isinstance(shard, dict) or shard.keys() != _SHARD_KEYS:
        found = sorted(shard) if isinstance(shard, dict) else shard
        yield f"a shard must have {', '.join(sorted(_SHARD_KEYS))}, found {shortened(found)}"
        return
    name, count, checksum = shard["name"], shard["num_patches"], shard["sha256"]
    if not (isinstance(name, str) and _SHARD_NAME.fullmatch(name)):
        yield f"shard {shortened(name)}: expected the name of a file in data/, such as part-00000.parquet"
    if not _is_count(count):
        yield f"shard {shortened(name)}: num_patches must be 0 or more, found {shortened(count)}"
    if not (isinstance(checksum, str) and _SHA256.fullmatch(checksum)):
        yield f"shard {shortened(name)}: sha256 must be 64 hexadecimal digits, found {shortened(checksum)}"


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53


def _manifest_from_json(content: dict[str, Any]) -> Manifest:
    return Manifest(
        sources=tuple(content["sources"]),
        shards=tuple(Shard(**shard) for shard in content["shards"]),
        is_finished=content["is_finished"],
        resume_key=content.get("resume_key"),
        format_version=content["format_version"],
    )
