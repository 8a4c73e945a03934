"""Random traffic: cars put into a scene so that none touches another, on the ground, facing along the road.

In the camera's own lane they drive ahead of it about as fast, in the lane to its left they come towards it. Where the
log has no poses they stand. The same seed gives the same cars.
"""

from dataclasses import dataclass

import numpy as np

from carstudio.errors import InputError
from carstudio.scene.edits import Edit, Insert, Place
from carstudio.scene.graph import PlacedBox, Scene, Track, Vector3
from carstudio.scene.places import box_standing, collide, is_in_view, posed_frames, turn_y
from carstudio.scene.shelf import CarShelf, find_car
from carstudio.scene.standing import Surroundings, boxes_along, surroundings_of
from carstudio.training.bundled import bundled_cars

LANE_M = 3.2  # between the middles of two lanes: streets have 2.75 to 3.5
_TRIES = 100  # in vain: the road is full
_NEAREST_M, _FARTHEST_M = 8.0, 45.0
_SEEN_SHARE = 1 / 3  # of the frames in which a car must be in view
_EGO_SIZE = (4.8, 1.6, 1.9)  # KITTI's car, a Passat estate


@dataclass(frozen=True)
class Traffic:
    """The edits, and one sentence where fewer cars than asked for found room."""

    edits: tuple[Edit, ...]
    problems: tuple[str, ...]


def random_traffic(scene: Scene, shelf: CarShelf, count: int, *, seed: int) -> Traffic:
    """`count` cars of the scene's tracks and of the package; `InputError` when there is no car to take."""
    if count < 1:
        raise InputError(f"--random must be at least 1, found {count}")
    names = [f"track:{name}" for name, track in sorted(scene.tracks.items()) if track.car is not None]
    names += list(bundled_cars())
    if not names:
        raise InputError("the scene has no car to put in; make it with a model that lifts its tracks")
    random = np.random.default_rng(seed)
    around = surroundings_of(scene)
    edits: list[Edit] = []
    filled = _with_ego(scene)
    sizes = {name: shelf.load(find_car(scene, shelf, name)).size for name in names}
    while len(edits) < count:
        found = None
        for _ in range(_TRIES):
            car = str(random.choice(names))
            edit = _draw(scene, car, _free_id(scene, len(edits)), random, has_path=around.path is not None)
            found = _room_for(edit, sizes[car], filled, around)
            if found is not None:
                edits.append(edit)
                filled = filled.with_track(Track(track_id=edit.track or "", boxes=found))
                break
        if found is None:
            break
    missing = count - len(edits)
    return Traffic(tuple(edits), (f"no room for {missing} of {count} cars",) if missing else ())


def _free_id(scene: Scene, number: int) -> str:
    name = f"random-{number + 1}"
    return name if name not in scene.tracks else f"random-{number + 1}-{len(scene.tracks)}"


def _draw(scene: Scene, car: str, track: str, random: np.random.Generator, *, has_path: bool) -> Insert:
    """One car in a lane: where it starts, how fast it goes."""
    first, last = scene.frames[0].index, scene.frames[-1].index
    is_oncoming = bool(random.random() < 0.5)
    left = (LANE_M if is_oncoming else 0.0) + float(random.normal(0, 0.15))
    start = float(random.uniform(_NEAREST_M, _FARTHEST_M))
    way = _ego_way(scene)
    if not has_path or first == last:
        yaw = 180.0 if is_oncoming else 0.0
        return Insert(car=car, track=track, frame="path", poses=(_place(first, start, left, yaw),))
    pace = float(random.uniform(0.9, 1.1))
    if is_oncoming:
        start += way  # meets the camera within the log, or nearly
        poses = (_place(first, start, left, 180.0), _place(last, start - way * pace, left, 180.0))
    else:
        poses = (_place(first, start, left, 0.0), _place(last, start + way * pace, left, 0.0))
    return Insert(car=car, track=track, frame="path", poses=poses)


def _place(at: int, along: float, left: float, yaw_deg: float) -> Place:
    return Place(at=at, position_m=(round(along, 2), round(left, 2)), yaw_deg=yaw_deg)


def _ego_way(scene: Scene) -> float:
    """Metres that the camera goes in the log."""
    places = np.array([pose[:3, 3] for _, pose in posed_frames(scene)])
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()) if len(places) > 1 else 0.0


def _with_ego(scene: Scene) -> Scene:
    """The scene with the car that carries the camera as one of its tracks."""
    ego = box_standing(turn_y(-np.pi / 2), np.array([0.0, 1.65, -0.3]), _EGO_SIZE)
    return scene.with_track(Track(track_id="ego", boxes={frame.index: ego for frame in scene.frames}))


def _room_for(edit: Insert, size: Vector3, scene: Scene, around: Surroundings) -> dict[int, PlacedBox] | None:
    """The car's boxes where they touch nothing in any frame and are seen in enough of them; else None."""
    boxes: dict[int, PlacedBox] = {}
    for frame in scene.frames:
        box = boxes_along(edit.poses, edit.frame, [frame], size, scene, around)[frame.index]
        others = (track.boxes.get(frame.index) for track in scene.tracks.values())
        if any(other is not None and collide(box, other) for other in others):
            return None
        boxes[frame.index] = box
    seen = sum(is_in_view(boxes[frame.index], frame) for frame in scene.frames)
    return boxes if seen >= _SEEN_SHARE * len(boxes) else None
