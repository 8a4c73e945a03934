"""Vehicle classes: what detectors call them, and the types that a store knows."""

# The names of COCO, Objects365, Open Images, KITTI and DD3D, in lower case.
VEHICLES = {
    "car": "Car",
    "suv": "Car",
    "sports car": "Car",
    "taxi": "Car",
    "van": "Van",
    "minivan": "Van",
    "pickup": "Truck",
    "pickup truck": "Truck",
    "truck": "Truck",
    "heavy truck": "Truck",
    "fire truck": "Truck",
    "bus": "Bus",
}
COCO_CLASS_NUMBERS = {2: "Car", 5: "Bus", 7: "Truck"}  # of the 80 classes, as networks count them
COCO_CATEGORY_IDS = {3: "Car", 6: "Bus", 8: "Truck"}  # of the dataset's 90 ids, as results files name them


def vehicle_type(name: str) -> str | None:
    """A store's type for a detector's class name; None when it is no vehicle of ours."""
    return VEHICLES.get(name.strip().lower().replace("_", " ").replace("-", " "))
