"""Networks of `transformers`, from the hub or a folder that `save_pretrained` wrote, with one message when they fail.

`transformers` fills weights that a file lacks with random numbers and a warning: here that is an error.
"""

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from carstudio.errors import InputError, first_line
from carstudio.hub import load_from_hub
from carstudio.perception.preprocessing import Preprocessing, parse_preprocessing

Precision = Literal["auto", "float32", "float16", "bfloat16"]


def read_config(name: str, model_types: tuple[str, ...], *, spec: str) -> Any:
    """The model's configuration; `InputError` unless it is one of `model_types`. `spec`: "sam", as users write it."""
    from transformers import AutoConfig

    _check_folder(name, spec)
    read = partial(AutoConfig.from_pretrained, trust_remote_code=False)  # never a model's own program, never a question
    config = _load(partial(load_from_hub, read, name), name, spec)
    if config.model_type not in model_types:
        raise InputError(
            f"{spec}:{name}: expected a model of type {' or '.join(model_types)}, found {config.model_type!r} in its "
            "config.json; name another model"
        )
    return config


def read_preprocessing(name: str, *, spec: str, step: int = 1) -> Preprocessing:
    """How the model wants its photographs; `InputError` when it does not say."""
    from transformers.image_processing_base import ImageProcessingMixin

    read = partial(load_from_hub, ImageProcessingMixin.get_image_processor_dict, name)
    try:
        config, _ = read()
    except (OSError, ValueError) as error:
        raise InputError(
            f"{spec}:{name}: no preprocessor_config.json, which says how to resize and normalise photographs; copy it "
            "from the model that this one was trained from"
        ) from error
    return parse_preprocessing(config, name=f"{spec}:{name}", step=step)


def read_network(build: Callable[..., Any], name: str, *, spec: str) -> nn.Module:
    """The network with its weights on the CPU, ready to be asked; `build` is `SomeModel.from_pretrained`."""
    with _without_progress_bars():
        load = partial(build, output_loading_info=True, dtype=torch.float32, trust_remote_code=False)
        network, found = _load(partial(load_from_hub, load, name), name, spec)
    missing = sorted(found["missing_keys"])
    if missing:
        raise InputError(
            f"{spec}:{name}: its weights lack {len(missing)} that the network has ({', '.join(missing[:3])} ...): they "
            "are of another model, or only a part; save it again with save_pretrained"
        )
    network.eval().requires_grad_(False)
    assert isinstance(network, nn.Module), "from_pretrained gives a network"
    return network


def low_precision(precision: Precision, device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Context in which layers compute in `precision`; "auto": float16 on CUDA, float32 elsewhere.

    Not bfloat16: its 8 bits would move an edge of a box by a pixel or two in a photograph 1200 px wide.
    """
    if precision == "auto":
        precision = "float16" if device.type == "cuda" else "float32"
    if precision == "float32":
        return contextlib.nullcontext()
    return torch.autocast(device.type, dtype=getattr(torch, precision))


def _check_folder(name: str, spec: str) -> None:
    folder = Path(name).expanduser()
    if folder.is_dir():
        if not (folder / "config.json").is_file():
            raise InputError(
                f"{spec}:{name}: no config.json in this folder; expected what save_pretrained writes (config.json, "
                "model.safetensors, preprocessor_config.json), or what `carstudio models download` puts into --out"
            )
    elif folder.is_absolute() or name.startswith((".", "~")) or name.count("/") > 1 or "\\" in name:
        raise InputError(f"{spec}:{name}: no such folder; expected a folder or a name of the hub, such as OWNER/MODEL")


def _load(load: Callable[[], Any], name: str, spec: str) -> Any:
    """`load()`, its many exceptions turned into one message that says the way out."""
    try:
        return load()
    except ImportError as error:
        raise InputError(f"{spec}:{name}: {first_line(error)}; install it, or choose another model") from error
    except OSError as error:
        if Path(name).is_dir():
            raise InputError(
                f"{spec}:{name}: no weights that can be read ({first_line(error)}); expected model.safetensors as "
                "save_pretrained writes it"
            ) from error
        raise InputError(
            f"{spec}:{name} is not on this machine and cannot be downloaded now; run `carstudio models download {name} "
            f"--out FOLDER` where there is a network, carry FOLDER here and say {spec}:FOLDER; or check the name "
            f"({first_line(error)})"
        ) from error
    except Exception as error:  # whatever a broken file makes transformers, safetensors or torch raise
        raise InputError(
            f"{spec}:{name}: cannot be loaded ({type(error).__name__}: {first_line(error)}); fetch the model again, "
            "or name another one"
        ) from error


@contextlib.contextmanager
def _without_progress_bars() -> Iterator[None]:
    """`transformers` draws a bar per load and warns of what is checked here anyway."""
    from transformers.utils import logging

    bars, level = logging.is_progress_bar_enabled(), logging.get_verbosity()
    logging.disable_progress_bar()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()
