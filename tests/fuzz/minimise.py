"""Making a find small: fewer edits first, then fewer bytes, as long as the same thing happens."""

import faulthandler
import json
import os
import random
import signal
from collections.abc import Callable
from pathlib import Path

from fuzz.campaign import Find, attempt, input_number
from fuzz.edits import Files, draw_edits
from fuzz.target import Target, make_input, write_files

TRIES = 400  # readings spent on one find


def same_thing(target: Target, folder: Path) -> Callable[[Files], str]:
    """A function that reads an input in a fork and tells the signature of what happened."""

    def signature(files: Files) -> str:
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            faulthandler.disable()
            signal.alarm(60)
            os.write(writing, attempt(target, files, folder)[1].encode())
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            said = pipe.read().decode()
        _, status = os.waitpid(pid, 0)
        return f"process ended by signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else said

    return signature


def minimise(target: Target, find: Find, *, seed: int, folder: Path) -> Files:
    """The smallest input with the find's signature that some tries came to."""
    seeds, happens = target.seeds(), same_thing(target, folder)
    files, edits = input_number(target, seeds, seed, find.index)
    if happens(files) != find.signature:
        return files  # it does not happen every time: keep it as it was
    rng = random.Random(f"{target.name} {seed} {find.index}")
    first, other = rng.randrange(len(seeds)), rng.randrange(len(seeds))
    assert draw_edits(rng) == edits
    for edit in list(edits):
        fewer = [kept for kept in edits if kept is not edit]
        made = make_input(target, seeds, fewer, first, other)
        if happens(made) == find.signature:
            files, edits = made, fewer
    return _fewer_bytes(files, lambda made: happens(made) == find.signature)


def _fewer_bytes(files: Files, is_same: Callable[[Files], bool]) -> Files:
    tries = TRIES
    for name in sorted(files):
        step = max(1, len(files[name]) // 2)
        while step and tries > 0:
            at = 0
            while at < len(files[name]) and tries > 0:
                shorter = {**files, name: files[name][:at] + files[name][at + step :]}
                tries -= 1
                if is_same(shorter):
                    files = shorter
                else:
                    at += step
            step //= 2
    return files


def save_find(files: Files, find: Find, folder: Path, *, command: str) -> None:
    """The input's files, and in `find.json` what happened and how to see it again."""
    write_files(files, folder)
    why = {"signature": find.signature, "index": find.index, "command": command, "trace": find.trace.splitlines()}
    (folder / "find.json").write_text(json.dumps(why, indent=2) + "\n")
