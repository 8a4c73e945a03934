"""The program `carstudio`: one verb, its options, one result.

Exit codes: 0 done; 2 the user's input or disk, with one message; 1 our fault, with a traceback to report, or a training
whose numbers ran away; 130 Ctrl-C, 143 SIGTERM, with what is saved and the command that goes on.
"""

import json
import logging
import os
import shlex
import signal
import sys
import traceback
import warnings
from importlib import import_module
from typing import TYPE_CHECKING

from carstudio import __version__
from carstudio.allocator import keep_freed_memory
from carstudio.commands.stopping import StopWatch
from carstudio.errors import InputError, Interrupted, StorageError

if TYPE_CHECKING:
    from carstudio.commands.command import Output

# verb -> (class that parses and runs it, what it does). The class is imported only when its verb is called.
VERBS = {
    "demo": ("carstudio.commands.demo:Demo", "nothing -> the whole path on synthetic cars, with an HTML report"),
    "synth": ("carstudio.commands.synth:Synth", "nothing or meshes -> photographs of synthetic cars with exact truth"),
    "build": ("carstudio.commands.build:Build", "KITTI-DET, KITTI-MOT or the authors' json -> CarPatch3D"),
    "dataset": (
        "carstudio.commands.dataset:Dataset",
        "CarPatch3D -> counts, checks, verdicts, splits, duplicates, other formats, an HTML report",
    ),
    "train": ("carstudio.commands.train:Train", "recipe + CarPatch3D -> trained model"),
    "evaluate": ("carstudio.commands.evaluate:Evaluate", "trained model + protocol -> result rows and their table"),
    "table": ("carstudio.commands.table:MakeTable", "the paper's tables -> every row trained and scored alike"),
    "report": ("carstudio.commands.report:WriteReport", "trained model + store -> both protocols, pictures, one page"),
    "fit": ("carstudio.commands.fit:Fit", "trained model + photos of one car -> that car, in a file"),
    "export": ("carstudio.commands.export:Export", "car -> GLB or splat PLY"),
    "render": ("carstudio.commands.render:Render", "trained model + photos -> turntables, opacity, depth"),
    "scene": ("carstudio.commands.scene:Scenes", "driving log -> frames and cars to edit"),
    "edit": ("carstudio.commands.edit:Edit", "scene + edit file -> edited frames with depth, masks and labels"),
    "models": ("carstudio.commands.models:Models", "pretrained networks: which there are, which are here, download"),
    "doctor": ("carstudio.commands.doctor:Doctor", "what is installed, what is missing, what it is for, how to get it"),
}


def main() -> None:
    """Entry point of the console script."""
    watch = StopWatch()
    watch.start()
    sys.exit(run(sys.argv[1:], watch))


def run(arguments: list[str], watch: StopWatch | None = None) -> int:
    """Parse and run one command line; returns the exit code."""
    watch = watch or StopWatch()
    watch.farewell = lambda: f"interrupted; nothing was written\n{go_on_with(arguments)}"
    try:
        return _run(arguments, watch)
    except KeyboardInterrupt as stop:
        watch.say_goodbye(lambda text: print(text, file=sys.stderr, flush=True))
        return 128 + (stop.signal if isinstance(stop, Interrupted) else signal.SIGINT)


def _run(arguments: list[str], watch: StopWatch) -> int:
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
    command = parse(verb, rest)
    watch.farewell = lambda: f"interrupted; {how_to_go_on(command, arguments)}"
    watch.raise_stops()
    try:
        return execute(command)
    except Exception as error:
        if watch.stopped_by is not None:  # a library has made something else of our `Interrupted`
            raise Interrupted(watch.stopped_by) from error
        return explain(error, command, arguments)


def parse(verb: str, options: list[str]) -> "Output":
    """The verb with its options; wrong ones end the program with exit code 2."""
    import tyro  # here and not above: from the first line on Ctrl-C is heard

    keep_freed_memory()
    module, name = VERBS[verb][0].split(":")
    command: Output = tyro.cli(
        getattr(import_module(module), name),
        prog=f"carstudio {verb}",
        args=options,
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes),
    )
    return command


def execute(command: "Output") -> int:
    """Run a parsed verb and print its outcome."""
    outcome = command.run()
    try:
        if outcome.text:  # of several processes that do one thing together only the first speaks
            print(json.dumps(outcome.value, indent=2) if command.json else outcome.text, flush=True)
    except BrokenPipeError:  # nobody reads on (`| head`): what could be said to whom?
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the buffer's rest goes there at the end
    return 0


def explain(error: Exception, command: "Output", arguments: list[str]) -> int:
    """One message for what ended a verb; returns the exit code."""
    if isinstance(error, StorageError) or (isinstance(error, OSError) and error.errno is not None):
        print(f"error: {error}\n{how_to_go_on(command, arguments)}", file=sys.stderr)
        return 2
    if isinstance(error, InputError):
        print(f"error: {error}", file=sys.stderr)
        return 2
    if isinstance(error, FloatingPointError):  # a training whose numbers ran away: no bug, yet no input either
        print(f"error: {error}", file=sys.stderr)
        return 1
    return our_fault(error, arguments)


def how_to_go_on(command: "Output", arguments: list[str]) -> str:
    """What is saved of a verb that was stopped, and the command that goes on."""
    try:
        saved = command.saved()
    except Exception:  # never a second error on top of the first
        saved = "what was finished is saved"
    return f"{saved}\n{go_on_with(command.again(arguments))}"


def go_on_with(arguments: list[str]) -> str:
    """The line with the command to copy."""
    return f"go on with: {shlex.join(['carstudio', *arguments])}"


def our_fault(error: Exception, arguments: list[str]) -> int:
    """Say that an exception is a bug of this program; exit code 1."""
    traceback.print_exception(error)
    print(
        f"\nThis is a fault of carstudio {__version__}, not of yours. Please report it with the lines above and the "
        f"command:\n  {shlex.join(['carstudio', *arguments])}",
        file=sys.stderr,
    )
    return 1


def usage() -> str:
    """The short help: one line per verb."""
    width = max(map(len, VERBS))
    verbs = "\n".join(f"  {verb:<{width}}  {what}" for verb, (_, what) in VERBS.items())
    return (
        f"carstudio {__version__}: from photographs of cars to metric, editable 3-D cars\n\n"
        f"usage: carstudio VERB ...    (carstudio VERB --help for its options)\n\n{verbs}"
    )
