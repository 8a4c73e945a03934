"""Target: the authors' json, with sound pictures beside it."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from carstudio.dataset.legacy_json.importer import LegacyJob, open_legacy
from dataset.authors_files import write_subset
from fuzz.edits import Files
from fuzz.store_targets import check_record
from fuzz.target import Target, write_files

JSONS = {"km": "km.json", "ko": "ko.json", "dv": "dv.json", "ns": "ns.json"}


@cache
def _files(subset: str) -> Files:
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_subset(folder, subset)
        paths = [path for path in folder.rglob("*") if path.is_file()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def legacy_seeds() -> list[Files]:
    """The json of each subset; and one with its pictures, which may be damaged too."""
    return [*({name: _files(subset)[name]} for subset, name in JSONS.items()), _files("km")]


def read_legacy(files: Files, folder: Path) -> None:
    """A sound patch, or the problem with it in words, for every record."""
    (name,) = [name for name in JSONS.values() if name in files]
    write_files({**_files(name.removesuffix(".json")), **files}, folder)
    source = open_legacy(folder / name)
    job = LegacyJob(source.folder, "exact")
    for result in map(job, source.items(frozenset())):
        assert bool(result.records) != bool(result.problems), result
        for record in result.records:
            check_record(record)
            record.decode()
        assert all(name in problem for problem in result.problems), result.problems


LEGACY_TARGETS = (Target("legacy", legacy_seeds, read_legacy),)
