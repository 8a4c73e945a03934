"""`./run fuzz --engine atheris --target NAME`: inputs bred towards code that no other has reached (libFuzzer).

An input is two bytes and the content of one file: which seed, which of its files is replaced by the content, whether
checksums are mended. The first find ends the run and is kept as libFuzzer writes it, beside the corpus.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from fuzz.edits import Files
from fuzz.target import Target, is_refused

MEND = 0x80  # in the first byte


def pack(seed: int, file: int, content: bytes, *, mend: bool) -> bytes:
    """An input of libFuzzer's."""
    return bytes([seed | (MEND if mend else 0), file]) + content


def unpack(target: Target, seeds: list[Files], data: bytes) -> Files:
    """The files of an input; any bytes are one."""
    first, second, content = (data + b"\0\0")[0], (data + b"\0\0")[1], data[2:]
    files = dict(seeds[(first & ~MEND) % len(seeds)])
    names = sorted(files)
    files[names[second % len(names)]] = content
    return target.mend(files) if first & MEND else files


def write_corpus(target: Target, seeds: list[Files], folder: Path) -> None:
    """Every file of every seed as it is."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, files in enumerate(seeds):
        for place, name in enumerate(sorted(files)):
            for mend in (False, True):
                (folder / f"seed-{index}-{place}-{int(mend)}").write_bytes(pack(index, place, files[name], mend=mend))


def run_guided(name: str, *, inputs: int, seed: int, out: Path) -> None:
    """Breed inputs for one target; does not return: libFuzzer ends the process (0, or 77 with a find in `out`)."""
    try:
        import atheris
    except ImportError:
        sys.exit("--engine atheris needs atheris (Linux): ./run setup fuzz, or pip install 'carstudio[fuzz]'")
    with atheris.instrument_imports(include=["carstudio"]):
        from fuzz.targets import TARGETS
    target = TARGETS[name]
    seeds = list(target.seeds())
    corpus = out / name / "corpus"
    write_corpus(target, seeds, corpus)

    def one_input(data: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            is_refused(target, unpack(target, seeds, data), Path(folder))

    options = [f"-runs={inputs}", f"-seed={seed + 1}", "-timeout=10", "-rss_limit_mb=8192", "-print_final_stats=1"]
    atheris.Setup(["fuzz", *options, f"-artifact_prefix={out / name}/find-", str(corpus)], one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--target", required=True)
    parser.add_argument("--inputs", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    wanted = parser.parse_args()
    run_guided(wanted.target, inputs=wanted.inputs, seed=wanted.seed, out=wanted.out)
