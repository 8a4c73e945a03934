"""How fast a large store is: `python -m bench.store --patches 100000` writes and reads a temporary one.

Records have the sizes of DVM-Cars patches (36 kB pictures, 3 kB masks). Open: manifest, footers and the index of ids.
Random: whole records by id. In order: records as an epoch without shuffling reads them.
"""

import argparse
import hashlib
import os
import random
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.store import StoreWriter, open_store

PICTURE_BYTES, MASK_BYTES = 36_000, 3_000


def _record(index: int) -> PatchRecord:
    return PatchRecord(
        patch_id=f"dv-{index:08d}",
        instance_id=f"car-{index // 3}",
        frame_id=f"{index:08d}",
        source="bench",
        image=b"",
        mask=bytes(MASK_BYTES),
        frame_path=f"{index:08d}.jpg",
        frame_width=300,
        frame_height=300,
        crop_x0=10,
        crop_y0=60,
        crop_width=280,
        crop_height=180,
        fx=721.5377,
        fy=721.5377,
        cx=150.0,
        cy=150.0,
        camera_source="paper",
        box2d=(10.0, 60.0, 289.5, 239.5),
        box_center=(0.1, 0.2, 8.0 + index * 1e-6),
        box_size=(4.2, 1.5, 1.8),
        box_yaw=0.001 * index,
        mask_ratio=0.8,
        licence="none",
        sha256=hashlib.sha256(str(index).encode()).hexdigest(),
    )


def _timed(label: str, work: Callable[[], object], count: int = 1) -> None:
    start = time.perf_counter()
    work()
    seconds = time.perf_counter() - start
    each = "" if count == 1 else f"{1000 * seconds / count:.3f} ms each"
    print(f"| {label} | {seconds:.2f} s | {each} |")


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--patches", type=int, default=20_000)
    parser.add_argument("--folder", type=Path, help="where the temporary store is written")
    options = parser.parse_args()
    noise = os.urandom(PICTURE_BYTES + 1000)
    generator = random.Random(0)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path = Path(folder) / "store"

        def write() -> None:
            with StoreWriter(path, source="bench") as writer:
                for index in range(options.patches):
                    writer.append(replace(_record(index), image=noise[index % 1000 : index % 1000 + PICTURE_BYTES]))

        print(f"| store of {options.patches} patches | time | |\n|---|---|---|")
        _timed("write", write, options.patches)
        store = open_store(path)
        _timed("open and index", store.patch_ids)
        chosen = generator.sample(store.patch_ids(), min(1000, options.patches))
        _timed("random record", lambda: [store.record(patch_id) for patch_id in chosen], len(chosen))
        _timed("the same again", lambda: [store.record(patch_id) for patch_id in chosen], len(chosen))
        first = store.patch_ids()[:2000]
        _timed("record in order", lambda: [store.record(patch_id) for patch_id in first], len(first))
        _timed("table without pictures", store.table)


if __name__ == "__main__":
    main()
