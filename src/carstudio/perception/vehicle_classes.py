"""Which classes of a detector are vehicles of ours: the names of COCO, Objects365, LVIS, Open Images, BDD and KITTI."""

import re
from collections.abc import Mapping

from carstudio.errors import InputError

_NAMES = {
    "Car": "car, automobile, suv, sports car, race car, taxi, cab, limousine, jeep, sedan, hatchback, police car",
    "Van": "van, minivan, ambulance",
    "Truck": "truck, pickup truck, pickup, heavy truck, fire truck, fire engine, garbage truck, tow truck, lorry",
    "Bus": "bus, school bus, minibus",
}
COCO_CLASS_NUMBERS = {2: "Car", 5: "Bus", 7: "Truck"}  # of the 80 classes, as networks count them
COCO_CATEGORY_IDS = {3: "Car", 6: "Bus", 8: "Truck"}  # of the data set's 90 ids, as results files name them
VEHICLE_TYPES = {name: kind for kind, names in _NAMES.items() for name in names.split(", ")}


def vehicle_type(class_name: str) -> str | None:
    """Our type ("Car", "Van", "Truck", "Bus") of a class name as data sets write it; None: no such vehicle."""
    words = re.sub(r"\(.*?\)", " ", class_name.lower()).replace("_", " ").replace("-", " ")
    return VEHICLE_TYPES.get(" ".join(words.split()))


def vehicle_classes(names: Mapping[int, str], *, model: str) -> dict[int, str]:
    """Class index -> our type, of the vehicles among a detector's classes; `InputError` when there are none."""
    found = {index: kind for index, name in names.items() if (kind := vehicle_type(name)) is not None}
    if not found:
        some = ", ".join(list(names.values())[:8])
        raise InputError(
            f"{model}: none of its {len(names)} classes is a vehicle; expected names like car, truck, bus or van, "
            f"found {some} ...; choose a detector trained on COCO or Objects365, or put class names into id2label "
            "of its config.json"
        )
    return found
