"""The program `carstudio`: one verb, its options, one result. Exit code 0 done, 2 the user's input, 1 ours."""

import json
import logging
import sys
import warnings
from importlib import import_module

import tyro

from carstudio import __version__
from carstudio.allocator import keep_freed_memory
from carstudio.commands.command import Output
from carstudio.errors import InputError

# verb -> (class that parses and runs it, what it does). The class is imported only when its verb is called.
VERBS = {
    "demo": ("carstudio.commands.demo:Demo", "nothing -> the whole path on synthetic cars, with an HTML report"),
    "synth": ("carstudio.commands.synth:Synth", "nothing or meshes -> photographs of synthetic cars with exact truth"),
    "build": ("carstudio.commands.build:Build", "KITTI-DET, KITTI-MOT or the authors' json -> CarPatch3D"),
    "dataset": (
        "carstudio.commands.dataset:Dataset",
        "CarPatch3D -> counts, a check of every byte, new verdicts, the authors' format",
    ),
    "train": ("carstudio.commands.train:Train", "recipe + CarPatch3D -> trained model"),
    "evaluate": ("carstudio.commands.evaluate:Evaluate", "trained model + protocol -> result rows and their table"),
    "render": ("carstudio.commands.render:Render", "trained model + photos -> turntables, opacity, depth"),
}


def main() -> None:
    """Entry point of the console script."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Parse and run one command line; returns the exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    warnings.filterwarnings("ignore", message=".*nested tensors.*")
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage())
        return 0
    if arguments[0] == "--version":
        print(f"carstudio {__version__}")
        return 0
    verb, *rest = arguments
    if verb not in VERBS:
        print(f"carstudio: no verb {verb!r}\n\n{usage()}", file=sys.stderr)
        return 2
    keep_freed_memory()
    module, name = VERBS[verb][0].split(":")
    command: Output = tyro.cli(
        getattr(import_module(module), name),
        prog=f"carstudio {verb}",
        args=rest,
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes),
    )
    return execute(command)


def execute(command: Output) -> int:
    """Run a parsed verb, print its outcome, and turn a user's error into one message."""
    try:
        outcome = command.run()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "interrupted; what was finished is saved: the same command goes on (train: add --resume)", file=sys.stderr
        )
        return 130
    print(json.dumps(outcome.value, indent=2) if command.json else outcome.text)
    return 0


def usage() -> str:
    """The short help: one line per verb."""
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {verb:<{width}}  {what}" for verb, (_, what) in VERBS.items())
    return (
        f"carstudio {__version__}: from photographs of cars to metric, editable 3-D cars\n\n"
        f"usage: carstudio VERB ...    (carstudio VERB --help for its options)\n\n{verbs}"
    )
