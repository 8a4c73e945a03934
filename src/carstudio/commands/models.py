"""`carstudio models list|download|convert|halve`: pretrained networks, which are here, bringing and passing on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from carstudio.commands.command import Outcome, Output, plain
from carstudio.commands.tables import table
from carstudio.errors import InputError
from carstudio.files import read_json
from carstudio.hub import is_in_cache
from carstudio.perception.downloads import Downloaded, download
from carstudio.perception.weights import ENCODER_OPTION, KNOWN_MODELS, full_name, option_for


@dataclass(frozen=True, kw_only=True)
class Models(Output):
    """Show which pretrained networks are here, download some of the hub, convert a public checkpoint, halve a model."""

    action: tyro.conf.Positional[Literal["list", "download", "convert", "halve"]]
    """list: the networks we know, and whether they are here; with folders: loads each and says how to use it.
    download: fetch networks of the hub. convert: make a public checkpoint (dd3d CHECKPOINT.pth) a folder of ours.
    halve: write a trained model of `carstudio train` with weights of half the size."""
    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """download: names as on the hub (facebook/sam-vit-huge), or without the owner where we know them. list: folders.
    convert: what it is, and the file: dd3d CHECKPOINT.pth. halve: the run's folder."""
    out: Path | None = None
    """download: a folder to carry elsewhere (with several names one folder below it for each), not the hub's cache.
    convert, halve: the folder to write."""

    def saved(self) -> str:
        """Whole files are kept, and the part of the one that was on its way."""
        return "what was downloaded is kept" if self.action == "download" else "nothing is changed"

    def run(self) -> Outcome:
        """Do what `action` says."""
        if self.action == "list":
            if self.out is not None:
                raise InputError("--out is for download, not for list")
            return check_folders(self.names) if self.names else list_models()
        if self.action == "convert":
            return convert_checkpoint(self.names, self.out)
        if self.action == "halve":
            return halve(self.names, self.out)
        if not self.names:
            raise InputError("download needs a name, such as sam-vit-huge; `carstudio models list` shows them")
        names = [full_name(name) for name in self.names]
        with self.progress() as report:
            fetched = [download(name, self._place(name), report) for name in names]
        return Outcome("\n".join(_describe(item, self.out) for item in fetched), {"downloaded": plain(fetched)})

    def _place(self, name: str) -> Path | None:
        if self.out is None or len(self.names) == 1:
            return self.out
        return self.out / name.rpartition("/")[2]


def _describe(item: Downloaded, out: Path | None) -> str:
    option = option_for(item.name, item.name if out is None else str(item.folder))
    use = f"; use it with {option}" if option else ""
    return f"{item.name}: {item.num_bytes / 1e6:.1f} MB in {item.folder}{use}"


def convert_checkpoint(names: tuple[str, ...], out: Path | None) -> Outcome:
    """`convert dd3d CHECKPOINT.pth --out FOLDER`."""
    from carstudio.perception.dd3d.weights import MODEL_TYPE, convert

    if len(names) != 2 or names[0] != MODEL_TYPE or out is None:
        raise InputError(
            f"convert: expected {MODEL_TYPE} CHECKPOINT.pth --out FOLDER, found {' '.join(names) or 'nothing'}"
            f"{'' if out else ' without --out'}"
        )
    made = convert(Path(names[1]).expanduser(), out)
    text = (
        f"{made.folder}: DD3D with {made.backbone}, {made.num_weights / 1e6:.1f} M numbers, "
        f"{made.num_bytes / 1e6:.0f} MB; use it with --box3d {MODEL_TYPE}:{made.folder}"
    )
    return Outcome(text, {"converted": plain(made)})


def halve(names: tuple[str, ...], out: Path | None) -> Outcome:
    """`halve RUN --out FOLDER`."""
    from carstudio.training.checkpoint import WEIGHTS, halve_model

    if len(names) != 1 or out is None:
        raise InputError(
            f"halve: expected RUN --out FOLDER, found {' '.join(names) or 'nothing'}{'' if out else ' without --out'}"
        )
    checksum = halve_model(Path(names[0]).expanduser(), out)
    num_bytes = (out / WEIGHTS).stat().st_size
    text = (
        f"{out}: {num_bytes / 1e6:.1f} MB of float16 weights (sha256 {checksum[:16]}); use it wherever the run would do"
    )
    return Outcome(text, {"folder": str(out), "sha256": checksum, "num_bytes": num_bytes})


def known_models() -> list[dict[str, Any]]:
    """The table of known models with `is_here`, as JSON values."""
    return [{**plain(model), "is_here": is_in_cache(model.name)} for model in KNOWN_MODELS]


def list_models() -> Outcome:
    """The known models and whether they are in the hub's cache."""
    models = known_models()
    rows = [
        (m["name"], "yes" if m["is_here"] else "no", f"{m['megabytes']} MB", m["licence"], m["purpose"]) for m in models
    ]
    text = table(("name", "here", "download", "licence", "for"), rows)
    how = "get one with: carstudio models download NAME    (others of the hub by their full name, OWNER/MODEL)"
    return Outcome(f"{text}\n{how}", {"models": models})


def check_folders(folders: tuple[str, ...]) -> Outcome:
    """Load each folder as a build would; `InputError` at the first that cannot be used."""
    options = {folder: option_of_folder(Path(folder).expanduser()) for folder in folders}
    text = "\n".join(f"{folder}: whole; use it with {option}" for folder, option in options.items())
    return Outcome(text, {"folders": options})


def option_of_folder(folder: Path) -> str:
    """The option that a folder with a network is for; `InputError` when the network cannot be loaded."""
    from carstudio.dataset.known_boxes import make_box_estimator
    from carstudio.models.encoders import ResNet34Encoder  # these take seconds to import: only where they are needed
    from carstudio.perception.specs import make_detector, make_segmenter

    if not (folder / "config.json").is_file():
        raise InputError(f"{folder}: no config.json; expected a folder with a network as save_pretrained writes it")
    settings = read_json(folder / "config.json")
    kind = settings.get("model_type") if isinstance(settings, dict) else None
    if kind == "resnet":
        ResNet34Encoder().load_pretrained(str(folder))
        return ENCODER_OPTION.format(folder)
    if kind == "dd3d":
        make_box_estimator(f"dd3d:{folder}")
        return f"--box3d dd3d:{folder}"
    if kind in ("sam", "sam2", "sam2_video"):
        spec = f"{kind.removesuffix('_video')}:{folder}"
        make_segmenter(spec)
        return f"--segmenter {spec}"
    make_detector(f"transformers:{folder}")
    return f"--detector transformers:{folder}"
