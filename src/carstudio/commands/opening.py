"""Opening a car together with the model it was made with."""

from pathlib import Path

from carstudio.errors import InputError
from carstudio.fitting.car_file import Car, load_car, put_weights
from carstudio.models.interface import CategoryModel
from carstudio.training.bundled import bundled_models
from carstudio.training.checkpoint import describe_model, load_model


def open_car(folder: Path, run: Path | None) -> tuple[CategoryModel, Car]:
    """The car of a folder and its model; `InputError` when it is another model than the one it was made with."""
    car = load_car(folder)
    if run is None:
        run = bundled_models().get(car.model_name)
    if run is None or (describe_model(run).sha256 != car.model_sha256 and run in bundled_models().values()):
        raise InputError(
            f"{folder}: made with the model {car.model_name} (weights {car.model_sha256[:16]}), which is not bundled; "
            "name its folder: --model RUN"
        )
    if describe_model(run).sha256 != car.model_sha256:
        raise InputError(
            f"{run}: not the model that {folder} was made with ({car.model_name}, weights {car.model_sha256[:16]}); "
            "fit the car again with this one"
        )
    model = load_model(run)
    put_weights(model, car, name=str(folder))
    return model, car
