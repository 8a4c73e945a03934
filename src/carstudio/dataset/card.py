"""A dataset card for the Hugging Face Hub: what is in a store, from where, under which licences, and how it was made.

`README.md` beside the data; its header tells `datasets.load_dataset` which files hold patches. It names no local path.
"""

from collections import Counter
from pathlib import Path

import numpy as np

from carstudio.dataset.measured import Measured, measure, reasons_in_order
from carstudio.dataset.runs import read_configs
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.files import write_text

SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
# First word of a licence in a store -> its name on the Hub.
HUB_LICENCES = {
    "CC-BY-NC-SA-3.0": "cc-by-nc-sa-3.0",
    "CC-BY-NC-SA-4.0": "cc-by-nc-sa-4.0",
    "CC-BY-NC-4.0": "cc-by-nc-4.0",
    "CC-BY-SA-4.0": "cc-by-sa-4.0",
    "CC-BY-4.0": "cc-by-4.0",
    "CC0-1.0": "cc0-1.0",
    "MIT": "mit",
    "Apache-2.0": "apache-2.0",
}
KITTI_NOTE = (
    "**Not for commercial use.** This dataset holds crops of photographs from the KITTI benchmark, which is licensed "
    "CC BY-NC-SA 3.0: name its authors, use it for no commercial purpose, and share what you make of it alike."
)
_STAGES = {"detector": "2-D boxes", "segmenter": "masks", "box3d": "3-D boxes", "camera": "intrinsics"}
_MARKS = str.maketrans({"|": "\\|", "\n": " ", "<": "&lt;", "`": "'"})


def write_card(store: PatchStore, *, title: str = "", force: bool = False) -> Path:
    """Write `README.md` into the store; `InputError` when another is there, unless `force`."""
    path = store.path / "README.md"
    if path.exists() and not force:
        raise InputError(f"{path}: is there already; --force replaces it")
    with store.writing():
        write_text(path, card_text(store, title=title))
    return path


def card_text(store: PatchStore, *, title: str = "") -> str:
    """The card as Markdown with its YAML header."""
    measured = measure(store)
    parts = [
        _header(measured, store),
        f"# {_plain(title or f'CarPatch3D: {store.path.resolve().name}')}",
        _what(measured),
        KITTI_NOTE if any("KITTI" in licence for licence in measured.licence.tolist()) else "",
        "## Sources and licences",
        _ledger(measured),
        "The licence in the last column is that of the photographs; boxes, masks and measurements were added to them.",
        "## How it was made",
        _provenance(store, measured),
        "## Contents",
        _contents(store, measured),
        "## Use",
        _use(store),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def hub_licence(licences: set[str]) -> str:
    """The Hub's name of the licence that all photographs have; `other` where there are several, or none it knows."""
    if len(licences) != 1:
        return "other"
    (licence,) = licences
    return HUB_LICENCES.get(licence.split(" ")[0], "other")


def _header(measured: Measured, store: PatchStore) -> str:
    licences = set(measured.licence.tolist())
    lines = ["---", f"license: {hub_licence(licences)}"]
    if lines[-1].endswith("other"):
        lines += ["license_name: several", "license_link: '#sources-and-licences'"]
    lines += ["task_categories:", "- image-to-3d", "- image-segmentation", "- object-detection"]
    lines += ["tags:", "- cars", "- carpatch3d", "- autonomous-driving", "size_categories:"]
    lines += [f"- {next((name for most, name in SIZES if len(measured) < most), '1M<n<10M')}", "configs:"]
    lines += ["- config_name: patches", "  default: true", "  data_files: data/part-*.parquet"]
    side = {"verdicts": "verdicts.parquet", "duplicates": "duplicates.parquet"}
    side |= {f"split-{name}": f"splits/{name}.parquet" for name in store.split_names()}
    for name, file in side.items():
        if (store.path / file).is_file():
            lines += [f"- config_name: {name}", f"  data_files: {file}"]
    return "\n".join([*lines, "---"])


def _what(measured: Measured) -> str:
    kept = measured.is_kept
    cars = len(set(measured.instance_id[kept].tolist()))
    total = max(1, int(kept.sum()))
    return (
        f"{int(kept.sum()):,} patches of {cars:,} cars, and {int((~kept).sum()):,} candidates that a filter rejected. "
        f"A patch is one car cropped from one photograph with its camera, 2-D box, 3-D box "
        f"({100 * (measured.has_box & kept).sum() / total:.0f} % of the kept) and mask "
        f"({100 * (measured.has_mask & kept).sum() / total:.0f} %). All positions are in pixels with centres at +0.5, "
        "lengths in metres, axes x right, y down, z forward."
    )


def _ledger(measured: Measured) -> str:
    rows = Counter(zip(measured.source.tolist(), measured.licence.tolist(), strict=True))
    kept = Counter(zip(measured.source[measured.is_kept], measured.licence[measured.is_kept], strict=True))
    lines = ["| source | patches | kept | licence of the photographs |", "|---|---:|---:|---|"]
    for pair, count in sorted(rows.items()):
        lines.append(f"| {_plain(pair[0])} | {count:,} | {kept[pair]:,} | {_plain(pair[1])} |")
    return "\n".join(lines)


def _provenance(store: PatchStore, measured: Measured) -> str:
    configs = read_configs(store.path)
    lines = []
    for key, what in _STAGES.items():
        specs = sorted({_without_folders(str(config[key])) for config in configs if config.get(key) is not None})
        if specs:
            lines.append(f"- {what}: {', '.join(f'`{_plain(spec)}`' for spec in specs)}")
    if "synthetic" in measured.source:
        lines.append("- synthetic photographs: cameras, boxes and masks are exact")
    if not lines:
        lines.append("- how masks and boxes were made is not recorded in this folder")
    cameras = Counter(measured.camera_source.tolist())
    lines.append(f"- cameras: {', '.join(f'`{_plain(name)}` ({count:,})' for name, count in sorted(cameras.items()))}")
    rules = [f"{name} {limit.text}" for name, limit in measured.thresholds.items()]
    lines.append(f"- filters: {'; '.join(rules) or 'none'}")
    iou = measured.values["box_iou"][measured.is_kept]
    if np.isfinite(iou).any():
        lines.append(
            f"- 2-D box and projected 3-D box overlap by an IoU of {np.nanmedian(iou):.3f} (median of the kept)"
        )
    lines.append("- mask values: 0 background, 128 unknown (another object in front, outside the photograph), 255 car")
    return "\n".join(lines)


def _without_folders(spec: str) -> str:
    """`onnx:/home/me/net.onnx` is `onnx:net.onnx`: a card tells nothing of somebody's disk."""
    kind, colon, argument = spec.partition(":")
    return f"{kind}{colon}{Path(argument).name}" if colon else Path(kind).name


def _contents(store: PatchStore, measured: Measured) -> str:
    lines = ["| verdict | patches |", "|---|---:|"]
    lines += [f"| {_plain(reason)} | {count:,} |" for reason, count in reasons_in_order(measured)]
    splits = [f"- split `{name}`: {_sides(store, name)}" for name in store.split_names()]
    return "\n".join([*lines, "", *splits, "", f"data_sha256: `{store.data_sha256}`"])


def _sides(store: PatchStore, name: str) -> str:
    sides = Counter(store.split(name).values())
    return f"{sides['train']:,} train, {sides['test']:,} test"


def _use(store: PatchStore) -> str:
    name = store.path.resolve().name
    return f"""```python
from datasets import load_dataset

patches = load_dataset("OWNER/{name}", "patches", split="train")  # every candidate; "train" is the Hub's word for all
verdicts = load_dataset("OWNER/{name}", "verdicts", split="train")  # which are kept, by patch_id
patches[0]["image"]
```

Columns are described in Car-Studio's `docs/dataset_format.md`; `carstudio dataset verify` checks a copy."""


def _plain(text: str) -> str:
    """Text that cannot break a table or a heading."""
    return text.translate(_MARKS)
