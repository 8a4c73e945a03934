"""All targets by name. A new one is a `Target` (seeds, a reader that asserts, perhaps a `mend`), entered here."""

from fuzz.checkpoint_targets import CHECKPOINT_TARGETS
from fuzz.image_targets import IMAGE_TARGETS
from fuzz.kitti_targets import KITTI_TARGETS
from fuzz.legacy_targets import LEGACY_TARGETS
from fuzz.store_targets import STORE_TARGETS
from fuzz.target import Target

_ALL = (*KITTI_TARGETS, *IMAGE_TARGETS, *STORE_TARGETS, *LEGACY_TARGETS, *CHECKPOINT_TARGETS)
TARGETS: dict[str, Target] = {target.name: target for target in _ALL}
