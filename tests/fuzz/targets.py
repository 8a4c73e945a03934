"""All targets by name. A new one: a `Target` (seeds, a reader that asserts, perhaps a `mend`), entered here.

For example, for a reader of JSON that gives records:

    def read_json_import(files: Files, folder: Path) -> None:
        write_files(files, folder)
        for record in records_of(folder / "km.json"):
            check_record(record)

    Target("json", lambda: [{"km.json": ..., "patch/km_0_patch.png": ...}], read_json_import)
"""

from fuzz.checkpoint_targets import CHECKPOINT_TARGETS
from fuzz.image_targets import IMAGE_TARGETS
from fuzz.kitti_targets import KITTI_TARGETS
from fuzz.store_targets import STORE_TARGETS
from fuzz.target import Target

TARGETS: dict[str, Target] = {
    target.name: target for target in (*KITTI_TARGETS, *IMAGE_TARGETS, *STORE_TARGETS, *CHECKPOINT_TARGETS)
}
