"""ONNX networks through onnxruntime, on one CPU thread: the same bits however many processes run."""

from pathlib import Path
from typing import Any

from carstudio.errors import InputError, first_line


def start_session(file: str, purpose: str) -> Any:
    """A session of one input; `InputError` when the package or file is missing or the file is no such network."""
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError('onnx: needs onnxruntime; install it with: pip install "carstudio[onnx]"') from error
    if not Path(file).is_file():
        raise InputError(f"onnx: no file {file}; expected a {purpose} network (onnx:FILE)")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no public base class
        raise InputError(f"{file}: expected an ONNX network, found something else ({first_line(error)})") from error
    if len(session.get_inputs()) != 1:
        found = [item.name for item in session.get_inputs()]
        raise InputError(f"{file}: expected one input, float32 [1, 3, height, width], found {found}")
    return session
