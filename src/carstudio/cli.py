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
    "build": ("carstudio.commands.build:Build", "KITTI-DET or KITTI-MOT -> CarPatch3D"),
    "dataset": ("carstudio.commands.dataset:Dataset", "CarPatch3D -> counts (info) or a check of every byte (verify)"),
    "train": ("carstudio.commands.train:Train", "recipe + CarPatch3D -> trained model"),
    "evaluate": ("carstudio.commands.evaluate:Evaluate", "trained model + protocol -> result rows and their table"),
    "render": ("carstudio.commands.render:Render", "trained model + photos -> turntables, opacity, depth"),
}


def main() -> None:
    """Entry point of the console script."""
    watch = StopWatch()
    watch.start()
    sys.exit(run(sys.argv[1:], watch))


def run(arguments: list[str], watch: StopWatch | None = None) -> int:
    """Parse and run one command line; returns the exit code."""
    watch = watch or StopWatch()
    try:
        return _run(arguments, watch)
    except KeyboardInterrupt as stop:
        watch.say(watch.farewell())
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
    return execute(command, arguments)


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


def execute(command: "Output", arguments: list[str]) -> int:
    """Run a parsed verb, print its outcome, and turn errors into one message and an exit code."""
    try:
        outcome = command.run()
        print(json.dumps(outcome.value, indent=2) if command.json else outcome.text, flush=True)
    except StorageError as error:
        print(f"error: {error}\n{how_to_go_on(command, arguments)}", file=sys.stderr)
        return 2
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # nobody reads on (`| head`): what could be said to whom?
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the buffer's rest goes there at the end
        return 0
    except OSError as error:
        if error.errno is None:  # not the system's but some library's
            return our_fault(arguments)
        print(f"error: {error}\n{how_to_go_on(command, arguments)}", file=sys.stderr)
        return 2
    except FloatingPointError as error:  # a training whose numbers ran away: no bug, yet no input either
        print(f"error: {error}", file=sys.stderr)
        return 1
    except Exception:
        return our_fault(arguments)
    return 0


def how_to_go_on(command: "Output", arguments: list[str]) -> str:
    """What is saved of a verb that was stopped, and the command that goes on."""
    try:
        saved = command.saved()
    except Exception:  # never a second error on top of the first
        saved = "what was finished is saved"
    return f"{saved}\ngo on with: {shlex.join(['carstudio', *command.again(arguments)])}"


def our_fault(arguments: list[str]) -> int:
    """Say that the exception being handled is a bug of this program; exit code 1."""
    traceback.print_exc()
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
