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

SEGMENTER_SPECS = ("grabcut", "ground-truth", "onnx:FILE", "precomputed:FOLDER", "precomputed:FILE.json")
DETECTOR_SPECS = ("labels", "onnx:FILE", "precomputed:FILE.json")


def parse_spec(spec: str) -> tuple[str, str | None]:
    """(kind, argument): only the first colon separates, so that arguments may hold drive letters."""
    kind, colon, argument = spec.partition(":")
    if not kind or (colon and not argument):
        raise InputError(f"spec {spec!r}: expected KIND or KIND:ARGUMENT, such as grabcut or onnx:segmenter.onnx")
    return kind, argument or None


def make_segmenter(spec: str) -> Segmenter:
    """The segmenter that `spec` names; `InputError` when it cannot work (no such file, package missing)."""
    kind, argument = parse_spec(spec)
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


def make_detector(spec: str) -> Detector:
    """The detector that `spec` names; `InputError` when it cannot work (no such file, package missing)."""
    kind, argument = parse_spec(spec)
    if kind == "onnx" and argument is not None:
        open_detector(argument)
        return OnnxDetector(Path(argument))
    if kind == "precomputed" and argument is not None:
        read_results(argument)
        return CocoDetector(Path(argument))
    raise InputError(f"detector {spec!r}: expected one of {', '.join(DETECTOR_SPECS)}")
