"""Opening a car together with the model it was made with."""

from pathlib import Path

from carstudio.errors import InputError
from carstudio.fitting.car_file import Car, load_car, put_weights
from carstudio.models.interface import CategoryModel
from carstudio.training.bundled import find_car_folder
from carstudio.training.checkpoint import describe_model, folder_of_weights, load_model


def open_car(path_or_name: Path, run: Path | None) -> tuple[CategoryModel, Car]:
    """The car of a folder, or a bundled one by its name, and its model.

    `InputError` when it is another model than the one it was made with.
    """
    folder = find_car_folder(path_or_name)
    car = load_car(folder)
    made_with = f"{car.model_name}, weights {car.model_sha256[:16]}"
    if run is not None and describe_model(run).sha256 != car.model_sha256:
        raise InputError(
            f"{run}: not the model that {folder} was made with ({made_with}); fit the car again with this one"
        )
    run = run or folder_of_weights(car.model_sha256)
    if run is None:
        raise InputError(
            f"{folder}: made with the model {made_with}, which is not bundled; name its folder: --model RUN"
        )
    model = load_model(run)
    put_weights(model, car, name=str(folder))
    return model, car
