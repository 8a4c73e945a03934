"""The authors' file names, which are all that tells a patch's photograph and its car.

After `patch/`, with fixed columns (S sequence, F photograph, O object, N running number):

    km_SSFFFFFOOO    vk_SSFFFFFOOO     the car is (sequence, object)
    dv_0NNNNNNOOOOOO                   the car is the advert O
    ko_00FFFFFOOOOO  ns_SSSFFFFFOOOOO  no identity across photographs: each patch is its own car
"""

import re
from dataclasses import dataclass

from carstudio.dataset.sources.kitti_format import KITTI_LICENCE

SUBSETS = ("km", "ko", "dv", "vk", "ns")  # the order in which a folder is read
DATASET_NAMES = {"km": "km", "ko": "ko", "dvm_car_studio": "dv", "vk": "vk", "ns": "ns"}  # dataset_name -> subset
LICENCES = {
    "km": KITTI_LICENCE,
    "ko": KITTI_LICENCE,
    "vk": "CC-BY-NC-SA-3.0 (Virtual KITTI)",
    "ns": "CC-BY-NC-SA-4.0 (nuScenes)",
    "dv": "unknown (DVM-Cars)",
}
_STEMS = {
    "km": re.compile(r"km_(?P<S>\d{2})(?P<F>\d{5})(?P<O>\d{3})", re.ASCII),
    "vk": re.compile(r"vk_(?P<S>\d{2})(?P<F>\d{5})(?P<O>\d{3})", re.ASCII),
    "ko": re.compile(r"ko_00(?P<F>\d{5})(?P<O>\d{5})", re.ASCII),
    "ns": re.compile(r"ns_(?P<S>\d{3})(?P<F>\d{5})(?P<O>\d{5})", re.ASCII),
    "dv": re.compile(r"dv_0(?P<N>\d{6})(?P<O>\d{6})", re.ASCII),
}
_OUR_KM = re.compile(r"km-00(?P<S>\d{2})-0(?P<F>\d{5})-(?P<O>\d{3})", re.ASCII)
_OUR_KO = re.compile(r"ko-0(?P<F>\d{5})-(?P<O>\d{3})", re.ASCII)


@dataclass(frozen=True)
class Identity:
    """The columns of a store that follow from a file's name. Ids of `km` are those that our `kitti-mot` gives."""

    patch_id: str
    instance_id: str
    frame_id: str
    sequence_id: str | None = None
    frame_index: int | None = None


def identify(subset: str, patch: str, index: int) -> Identity:
    """What the path of a patch says; with a name outside the grammar each patch is its own car, named by its place."""
    stem = patch.rsplit("/", 1)[-1].removesuffix("_patch.png")
    found = _STEMS[subset].fullmatch(stem)
    if found is None:
        name = f"{subset}-at{index:06d}"
        return Identity(name, name, name)
    part = found.groupdict()
    if subset == "dv":
        return Identity(f"dv-{part['N']}-{part['O']}", f"dv-{part['O']}", f"dv-{part['N']}")
    frame = int(part["F"])
    if subset == "ko":
        name = f"ko-{frame:06d}-{part['O']}"
        return Identity(name, name, f"ko-{frame:06d}")
    sequence = f"{int(part['S']):04d}"
    patch_id = f"{subset}-{sequence}-{frame:06d}-{part['O']}"
    instance_id = patch_id if subset == "ns" else f"{subset}-{sequence}-{part['O']}"
    return Identity(patch_id, instance_id, f"{subset}-{sequence}-{frame:06d}", sequence, frame)


def name_patch(patch_id: str, running: int, car: int) -> tuple[str, str]:
    """(subset, stem) for a patch that never was in the authors' files.

    KITTI's patches get their names; all others are named as in `dv`, the one grammar that tells the car and nothing
    of a drive: `running` is the patch's number in the file, `car` its car's, both below a million.
    """
    if found := _OUR_KM.fullmatch(patch_id):
        return "km", f"km_{found['S']}{found['F']}{found['O']}"
    if found := _OUR_KO.fullmatch(patch_id):
        return "ko", f"ko_00{found['F']}{int(found['O']):05d}"
    assert max(running, car) < 1_000_000, (running, car)
    return "dv", f"dv_0{running:06d}{car:06d}"
