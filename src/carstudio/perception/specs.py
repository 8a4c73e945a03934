"""Component specs of the command line: `kind` or `kind:argument`."""

from pathlib import Path

from carstudio.errors import InputError
from carstudio.perception.coco import CocoDetector, CocoSegmenter, read_results
from carstudio.perception.grabcut import GrabCutSegmenter
from carstudio.perception.ground_truth import GroundTruthSegmenter
from carstudio.perception.onnx_detector import OnnxDetector, open_detector
from carstudio.perception.onnx_segmenter import OnnxSegmenter, open_session
from carstudio.perception.precomputed import PrecomputedSegmenter
from carstudio.perception.results import Detector, Segmenter
from carstudio.perception.sam import SamSegmenter, open_sam
from carstudio.perception.sam2 import Sam2Segmenter, open_sam2
from carstudio.perception.transformers_detector import TransformersDetector, open_network
from carstudio.perception.weights import DEFAULT_DETECTOR, DEFAULT_SAM, DEFAULT_SAM2

DETECTOR_SPECS = ("labels", "transformers[:NAME_OR_FOLDER]", "onnx:FILE", "precomputed:FILE.json")
SEGMENTER_SPECS = (
    "grabcut",
    "sam[:NAME_OR_FOLDER]",
    "sam2[:NAME_OR_FOLDER]",
    "onnx:FILE",
    "precomputed:FOLDER",
    "precomputed:FILE.json",
    "ground-truth",
)


def parse_spec(spec: str) -> tuple[str, str | None]:
    """(kind, argument): only the first colon separates, so that arguments may hold drive letters."""
    kind, colon, argument = spec.partition(":")
    if not kind or (colon and not argument):
        raise InputError(f"spec {spec!r}: expected KIND or KIND:ARGUMENT, such as grabcut or onnx:segmenter.onnx")
    return kind, argument or None


def make_detector(spec: str) -> Detector:
    """The detector that `spec` names; `InputError` when it cannot work (no such file, weights or package missing)."""
    kind, argument = parse_spec(spec)
    if kind == "transformers":
        return make_transformers_detector(argument)
    if kind == "onnx" and argument is not None:
        open_detector(argument)
        return OnnxDetector(Path(argument))
    if kind == "precomputed" and argument is not None:
        read_results(argument)
        return CocoDetector(Path(argument))
    raise InputError(f"detector {spec!r}: expected one of {', '.join(DETECTOR_SPECS)}")


def make_transformers_detector(argument: str | None) -> TransformersDetector:
    """A detector of transformers, loaded once on the CPU to see that it works."""
    name = _expanded(argument, DEFAULT_DETECTOR)
    open_network.__wrapped__(name, "cpu")
    return TransformersDetector(name)


def make_segmenter(spec: str) -> Segmenter:
    """The segmenter that `spec` names; `InputError` when it cannot work (no such file, package missing)."""
    kind, argument = parse_spec(spec)
    if kind in ("sam", "sam2"):
        return _make_sam(kind, argument)
    if kind == "grabcut" and argument is None:
        return GrabCutSegmenter()
    if kind == "ground-truth" and argument is None:
        return GroundTruthSegmenter()
    if kind == "onnx" and argument is not None:
        open_session(argument)
        return OnnxSegmenter(Path(argument))
    if kind == "precomputed" and argument is not None:
        if Path(argument).is_file():
            read_results(argument)
            return CocoSegmenter(Path(argument))
        if not Path(argument).is_dir():
            raise InputError(
                f"precomputed: no folder {argument} (with PATCH_ID.png or FRAME_ID.png), and no file (COCO JSON)"
            )
        return PrecomputedSegmenter(Path(argument))
    raise InputError(f"segmenter {spec!r}: expected one of {', '.join(SEGMENTER_SPECS)}")


def _make_sam(kind: str, argument: str | None) -> SamSegmenter | Sam2Segmenter:
    """Loaded once on the CPU to see that it works, and let go: the processes that use it load their own."""
    if kind == "sam":
        name = _expanded(argument, DEFAULT_SAM)
        open_sam.__wrapped__(name, "cpu")
        return SamSegmenter(name=name)
    name = _expanded(argument, DEFAULT_SAM2)
    open_sam2.__wrapped__(name, "cpu")
    return Sam2Segmenter(name=name)


def _expanded(argument: str | None, default: str) -> str:
    """The argument with `~` for the home folder, or the default name."""
    if argument is None:
        return default
    return str(Path(argument).expanduser()) if argument.startswith("~") else argument
