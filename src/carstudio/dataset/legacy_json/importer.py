"""`carstudio build legacy-json`: the authors' json, patches and masks as they are -> CarPatch3D.

A broken record costs only itself; a file that is no such JSON at all is the user's error before anything is written.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from carstudio.dataset.candidates import FrameResult
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.legacy_json.convert import patch_record
from carstudio.dataset.legacy_json.names import DATASET_NAMES, SUBSETS, Identity, identify
from carstudio.dataset.legacy_json.stream import LegacyFile, RawInstance, read_instances, scan_file
from carstudio.dataset.sources.frame import CameraOffset
from carstudio.errors import InputError
from carstudio.progress import Report, silent

SOURCE = "legacy-json"
# The authors have filtered already, and `released-patch` counts their patches: everything they published is kept.
KEEP_RELEASED = FilterRecipe(
    height_px=0.0, width_px=0.0, depth_m=1e9, score_mask=0.0, mask_ratio=-1.0, box_iou=0.0
)  # fmt: skip


@dataclass(frozen=True)
class LegacyItem:
    """One record on its way to a process."""

    json: str
    dataset_name: str
    identity: Identity
    raw: RawInstance


@dataclass(frozen=True)
class LegacySource:
    """The authors' files below `folder`, each read through once."""

    folder: Path
    files: tuple[LegacyFile, ...]

    @property
    def num_instances(self) -> int:
        """Records in all files."""
        return sum(file.num_instances for file in self.files)

    def items(self, done: frozenset[str] = frozenset()) -> Iterator[LegacyItem]:
        """Every record that is not `done`, in file order; a name used before gets a number behind it."""
        seen: dict[str, int] = {}
        for file in self.files:
            subset = DATASET_NAMES[file.dataset_name]
            for raw in read_instances(file.path):
                identity = _unique(identify(subset, _patch_path(raw), raw.index), seen)
                if identity.patch_id not in done:
                    yield LegacyItem(file.path.with_suffix(".json").name, file.dataset_name, identity, raw)


def _patch_path(raw: RawInstance) -> str:
    path = raw.value.get("patch") if isinstance(raw.value, dict) else None
    return path if isinstance(path, str) else ""


def _unique(identity: Identity, seen: dict[str, int]) -> Identity:
    name = identity.patch_id
    seen[name] = number = seen.get(name, 0) + 1
    if number == 1:
        return identity
    instance = f"{name}.{number}" if identity.instance_id == name else identity.instance_id
    return Identity(f"{name}.{number}", instance, identity.frame_id, identity.sequence_id, identity.frame_index)


@dataclass(frozen=True)
class LegacyJob:
    """Turns records into patches, in any process."""

    folder: Path
    camera_offset: CameraOffset

    def __call__(self, item: LegacyItem) -> FrameResult:
        """The patch of one record, or the problem with it."""
        try:
            record = patch_record(
                self.folder,
                item.raw,
                json=item.json,
                dataset_name=item.dataset_name,
                identity=item.identity,
                camera_offset=self.camera_offset,
            )
        except InputError as error:
            return FrameResult((), (f"{item.json} instances[{item.raw.index}] skipped: {error}",))
        return FrameResult((record,))


def open_legacy(root: Path, *, subset: str | None = None, report: Report = silent) -> LegacySource:
    """The json files that `root` names: the file itself, or those of a folder (all, or one `subset`)."""
    paths = _json_paths(root, subset)
    files = []
    for done, path in enumerate(paths, start=1):
        file = scan_file(path)
        if file.dataset_name not in DATASET_NAMES:
            names, found = ", ".join(DATASET_NAMES), file.dataset_name[:60]
            raise InputError(f"{path}: expected dataset_name to be one of {names}, found {found!r}")
        files.append(file)
        report("read through", done, len(paths), path.name)
    source = LegacySource(paths[0].parent, tuple(files))
    if not source.num_instances:
        raise InputError(f"{', '.join(map(str, paths))}: expected a list of instances, found an empty one")
    return source


def _json_paths(root: Path, subset: str | None) -> list[Path]:
    if subset is not None and subset not in SUBSETS:
        raise InputError(f"--subset {subset!r}: expected one of {', '.join(SUBSETS)}")
    if root.is_file():
        if subset is not None:
            raise InputError(f"--subset {subset}: --root {root} is one file already; give its folder or no --subset")
        return [root]
    wanted = SUBSETS if subset is None else (subset,)
    for folder in (root, root / "car_studio"):
        paths = [folder / f"{name}.json" for name in wanted if (folder / f"{name}.json").is_file()]
        if paths:
            return paths
    names = ", ".join(f"{name}.json" for name in wanted)
    raise InputError(
        f"{root}: expected the authors' json, or a folder with {names} beside patch/ and mask/; found none"
    )
