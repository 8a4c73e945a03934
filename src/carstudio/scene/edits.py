"""What can be done to a scene, as values: the edit file's entries and the Python API are the same classes.

`Move(track="4", translation_m=(2, 0, 0), frame="car")`. `editing.apply_edits` does them to a scene.
"""

import re
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PrivateAttr, model_validator

from carstudio.scene.graph import Vector3

AxesName = Literal["camera", "car", "world", "path"]
_MOST_M = 10_000.0  # of a place or a way: no log is longer
_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?", re.ASCII)
Metres = Annotated[float, Field(ge=-_MOST_M, le=_MOST_M, allow_inf_nan=False)]
Side = Annotated[float, Field(gt=0, le=30, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=-3600, le=3600, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


def _name(value: Any) -> Any:
    """Track ids are texts; YAML reads 4 as a number."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _range(value: Any) -> Any:
    """`3-7` or `3` as (3, 7), (3, 3)."""
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value, value
    if isinstance(value, (tuple, list)):
        return value
    found = _RANGE.fullmatch(value) if isinstance(value, str) else None
    if found is None:
        raise ValueError("expected frames A-B (both included) or one frame, such as 0-24")
    first = int(found[1])
    last = int(found[2] or first)
    if last < first:
        raise ValueError(f"expected frames A-B with A not above B, found {first} > {last}")
    return first, last


Name = Annotated[str, BeforeValidator(_name), Field(min_length=1, max_length=400)]
Frames = Annotated[tuple[int, int] | None, BeforeValidator(lambda value: None if value is None else _range(value))]


class Place(BaseModel):
    """Where a car stands at one frame: the centre of its bottom face, m, in the edit's `frame`.

    Two numbers leave out y: the car stands on the ground. `yaw_deg` turns it from the frame's x axis (KITTI's sense);
    left out, it faces the way it goes, or along the road when it stands.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    at: Annotated[int, Field(ge=0)]
    position_m: tuple[Metres, Metres] | tuple[Metres, Metres, Metres]
    yaw_deg: Degrees | None = None


class Edit(BaseModel):
    """What all edits share. `frames`: first and last, both included; None: all."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    op: str
    frames: Frames = None
    _lines: dict[str, int] = PrivateAttr(default_factory=dict)
    _file: str = PrivateAttr(default="")

    def where(self, field: str = "op") -> str:
        """File and line of a field, for messages; empty where the edit comes from no file."""
        return f"{self._file} line {self._lines.get(field, self._lines.get('op', 1))}" if self._file else ""

    def came_from(self, file: str, lines: dict[str, int]) -> None:
        """Remember the file and the line of each field."""
        self._file, self._lines = file, lines


class Insert(Edit):
    """Put a car in: it stands at one place, or drives from place to place."""

    op: Literal["insert"] = "insert"
    car: Name
    track: Name | None = None
    frame: AxesName = "camera"
    poses: Annotated[tuple[Place, ...], Field(min_length=1, max_length=100_000)]
    size_m: tuple[Side, Side, Side] | None = None


class Move(Edit):
    """Move a car by a vector (m) along the axes of `frame`."""

    op: Literal["move"] = "move"
    track: Name
    translation_m: tuple[Metres, Metres, Metres]
    frame: AxesName = "camera"


class Rotate(Edit):
    """Turn a car about its own upright axis, KITTI's sense: positive turns it to its right."""

    op: Literal["rotate"] = "rotate"
    track: Name
    yaw_deg: Degrees
    frame: Literal["camera", "car", "world"] = "car"


class Resize(Edit):
    """Give a car another size (length, height, width, m), or scale it; it stays where it stands."""

    op: Literal["resize"] = "resize"
    track: Name
    size_m: tuple[Side, Side, Side] | None = None
    scale: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _one_of(self) -> "Resize":
        if (self.size_m is None) == (self.scale is None):
            raise ValueError("expected either size_m (length, height, width in m) or scale")
        return self


class Delete(Edit):
    """Take a car away."""

    op: Literal["delete"] = "delete"
    track: Name


class Replace(Edit):
    """Put another car in a car's place; it has its own size unless `size_m` says another."""

    op: Literal["replace"] = "replace"
    track: Name
    car: Name
    size_m: tuple[Side, Side, Side] | None = None


class Recolour(Edit):
    """Give a car another colour; its shape stays as it is, to the bit.

    `paint` changes the paint alone (glass, lamps, tyres stay); `paper` is Car-Studio's: a transparent colour laid over
    the photograph, of which only the texture code is taken; `mix` takes `amount` of the texture code of `car`.
    """

    op: Literal["recolour"] = "recolour"
    track: Name
    colour: str | tuple[float, float, float] | None = None
    way: Literal["paint", "paper", "mix"] = "paint"
    car: Name | None = None
    amount: Share | None = None

    @model_validator(mode="after")
    def _needs(self) -> "Recolour":
        if self.way == "mix" and self.car is None:
            raise ValueError("way: mix needs a car whose texture is mixed in")
        if self.way != "mix" and self.colour is None:
            raise ValueError(f"way: {self.way} needs a colour, such as '#c01020' or red")
        return self


class Trajectory(Edit):
    """Let a car that is there drive from place to place."""

    op: Literal["trajectory"] = "trajectory"
    track: Name
    frame: AxesName = "camera"
    poses: Annotated[tuple[Place, ...], Field(min_length=1, max_length=100_000)]


AnyEdit = Annotated[
    Insert | Move | Rotate | Resize | Delete | Replace | Recolour | Trajectory, Field(discriminator="op")
]
OPS = ("insert", "move", "rotate", "resize", "delete", "replace", "recolour", "trajectory")
Size = Vector3
