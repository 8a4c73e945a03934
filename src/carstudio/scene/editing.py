"""Doing edits to a scene: each gives a new scene; nothing is drawn here.

What an edit changes is drawn in the frames it changes; all else stays with the photographs. An edit of a range that
changes a car's look (replace, recolour) splits its track: the frames of the range become a track of their own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from carstudio.dataset.schema import check_id
from carstudio.errors import InputError
from carstudio.scene.edit_file import nearest
from carstudio.scene.edits import Delete, Edit, Insert, Move, Recolour, Replace, Resize, Rotate, Trajectory
from carstudio.scene.graph import CarRef, PlacedBox, Scene, SceneFrame, Track
from carstudio.scene.places import (
    as_ranges,
    box_at,
    box_standing,
    collide,
    is_in_view,
    pose_of,
    standing,
    turn_y,
)
from carstudio.scene.recolour import recolour_car
from carstudio.scene.shelf import CarShelf, find_car
from carstudio.scene.standing import Surroundings, boxes_along, need_pose, surroundings_of

_OFF_GROUND_M = 0.4  # labels of KITTI lie within 0.3 m of the fitted ground


@dataclass(frozen=True)
class Edited:
    """The scene after the edits, and what looks wrong with it."""

    scene: Scene
    warnings: tuple[str, ...]


def apply_edits(scene: Scene, edits: Sequence[Edit], shelf: CarShelf) -> Edited:
    """Do the edits in order. New cars (recoloured, taken from elsewhere) are put on `shelf`.

    `InputError` names the edit (file and line where it has them) and the nearest valid name.
    """
    around = surroundings_of(scene)
    result = scene
    for number, edit in enumerate(edits, start=1):
        try:
            result = _DO[type(edit)](result, edit, shelf, around)
        except InputError as error:
            field = error.field if isinstance(error, _FieldError) else "op"
            place = edit.where(field) or f"edit {number} ({edit.op})"
            raise InputError(f"{place}: {error}") from error
    return Edited(result, tuple(warnings_of(scene, result, around)))


class _FieldError(InputError):
    """What is wrong with one field of an edit; where that stands is known to `apply_edits`."""

    def __init__(self, field: str, text: str) -> None:
        super().__init__(text)
        self.field = field


def frames_of(scene: Scene, edit: Edit) -> list[SceneFrame]:
    """The frames an edit is about; `InputError` when the scene has none of them."""
    if edit.frames is None:
        return list(scene.frames)
    first, last = edit.frames
    found = [frame for frame in scene.frames if first <= frame.index <= last]
    if not found:
        there = as_ranges(frame.index for frame in scene.frames)
        raise _FieldError("frames", f"the scene has no frame of {first}-{last}; it has {there}")
    return found


def _track(scene: Scene, edit: Any) -> Track:
    if edit.track not in scene.tracks:
        raise _FieldError("track", f"no track {edit.track!r}{nearest(edit.track, scene.tracks, 'tracks')}")
    return scene.tracks[edit.track]


def _boxes(scene: Scene, edit: Any) -> tuple[Track, dict[int, PlacedBox]]:
    """The track and its boxes in the edit's frames; `InputError` when there are none."""
    track, frames = _track(scene, edit), {frame.index for frame in frames_of(scene, edit)}
    boxes = {index: box for index, box in track.boxes.items() if index in frames}
    if not boxes:
        there = as_ranges(track.boxes)
        raise _FieldError("frames", f"track {edit.track} has no box in these frames; it is there in {there}")
    return track, boxes


def _drawable(track: Track, edit: Edit) -> Track:
    if track.car is None:
        raise _FieldError(
            "track",
            f"track {track.track_id} has no car (no photograph shows it well enough); it can be deleted or replaced",
        )
    return track


def redrawn(track: Track, boxes: dict[int, PlacedBox]) -> Track:
    """The track with these boxes put in, drawn there."""
    drawn = {index for index in track.boxes if track.is_drawn_at(index)} | set(boxes)
    merged = {**track.boxes, **boxes}
    merged = {index: merged[index] for index in sorted(merged)}
    return replace(track, boxes=merged, is_drawn=True, drawn_in=_all_or(drawn, merged))


def _all_or(drawn: set[int], boxes: dict[int, PlacedBox]) -> frozenset[int] | None:
    return None if drawn >= set(boxes) else frozenset(drawn)


def _each(scene: Scene, edit: Any, change: Callable[[PlacedBox, SceneFrame], PlacedBox]) -> Scene:
    """Change each box of the edit's frames."""
    track, boxes = _boxes(scene, edit)
    _drawable(track, edit)
    return scene.with_track(redrawn(track, {i: change(box, scene.frame(i)) for i, box in boxes.items()}))


def _insert(scene: Scene, edit: Insert, shelf: CarShelf, around: Surroundings) -> Scene:
    if edit.track is not None and edit.track in scene.tracks:
        raise _FieldError("track", f"there is a track {edit.track!r} already; give the new one another id")
    if edit.frame == "car":
        raise _FieldError("frame", "a new car has no box to count from; use camera, world or path")
    name = check_id(edit.track or _new_id(scene), "track")
    ref = _car(scene, edit, shelf)
    size = edit.size_m or shelf.load(ref).size
    boxes = boxes_along(edit.poses, edit.frame, _driven(scene, edit), size, scene, around)
    return scene.with_track(Track(track_id=name, boxes=boxes, car=ref, is_drawn=True))


def _new_id(scene: Scene) -> str:
    number = 1
    while f"new-{number}" in scene.tracks:
        number += 1
    return f"new-{number}"


def _driven(scene: Scene, edit: Insert | Trajectory) -> list[SceneFrame]:
    """The frames of an edit with poses: those asked for; else from first to last pose; all for one pose."""
    if edit.frames is None and len(edit.poses) > 1:
        times = [place.at for place in edit.poses]
        found = [frame for frame in scene.frames if min(times) <= frame.index <= max(times)]
        if found:
            return found
    return frames_of(scene, edit)


def _move(scene: Scene, edit: Move, shelf: CarShelf, around: Surroundings) -> Scene:
    way = np.array(edit.translation_m)

    def change(box: PlacedBox, frame: SceneFrame) -> PlacedBox:
        pose = pose_of(box)
        if edit.frame == "path" and around.path is not None:
            return box_at(_moved_along(pose, way, frame, around), box.size)
        axes = {
            "camera": lambda: np.eye(3),
            "car": lambda: pose[:3, :3],
            "world": lambda: need_pose(frame, "world")[:3, :3].T,
            "path": lambda: turn_y(-np.pi / 2),
        }[edit.frame]()
        pose[:3, 3] += axes @ way
        return box_at(pose, box.size)

    return _each(scene, edit, change)


def _moved_along(pose: np.ndarray, way: np.ndarray, frame: SceneFrame, around: Surroundings) -> np.ndarray:
    """A pose moved along and across the path, turning with it."""
    assert around.path is not None
    camera = need_pose(frame, "path")
    world = camera @ pose
    place, yaw = around.path.to_path(world[:3, 3])
    world[:3, 3], new_yaw = around.path.from_path(*(place + way).tolist())
    world[:3, :3] = turn_y(new_yaw - yaw) @ world[:3, :3]
    result: np.ndarray = np.linalg.inv(camera) @ world
    return result


def _rotate(scene: Scene, edit: Rotate, shelf: CarShelf, around: Surroundings) -> Scene:
    turn = turn_y(np.radians(edit.yaw_deg))

    def change(box: PlacedBox, frame: SceneFrame) -> PlacedBox:
        pose = pose_of(box)
        if edit.frame == "car":
            rotation = pose[:3, :3] @ turn
        elif edit.frame == "camera":
            rotation = turn @ pose[:3, :3]
        else:
            world = need_pose(frame, "world")[:3, :3]
            rotation = world.T @ turn @ world @ pose[:3, :3]
        return box_standing(rotation, standing(box), box.size)

    return _each(scene, edit, change)


def _resize(scene: Scene, edit: Resize, shelf: CarShelf, around: Surroundings) -> Scene:
    def change(box: PlacedBox, frame: SceneFrame) -> PlacedBox:
        length, height, width = box.size
        scale = edit.scale or 1.0
        size = edit.size_m or (length * scale, height * scale, width * scale)
        return box_standing(pose_of(box)[:3, :3], standing(box), size)

    return _each(scene, edit, change)


def _delete(scene: Scene, edit: Delete, shelf: CarShelf, around: Surroundings) -> Scene:
    track, gone = _boxes(scene, edit)
    kept = without_boxes(track, set(gone))
    return scene.with_track(kept) if kept.boxes else scene.without_track(track.track_id)


def without_boxes(track: Track, gone: set[int]) -> Track:
    """The track with some of its frames taken out."""
    boxes = {index: box for index, box in track.boxes.items() if index not in gone}
    labels = {index: label for index, label in track.labels.items() if index not in gone}
    drawn = {index for index in boxes if track.is_drawn_at(index)}
    return replace(
        track, boxes=boxes, labels=labels, is_drawn=bool(drawn), drawn_in=_all_or(drawn, boxes) if drawn else None
    )


def _replace(scene: Scene, edit: Replace, shelf: CarShelf, around: Surroundings) -> Scene:
    track, boxes = _boxes(scene, edit)
    ref = _car(scene, edit, shelf)
    size = edit.size_m or shelf.load(ref).size
    new = {i: box_standing(pose_of(box)[:3, :3], standing(box), size) for i, box in boxes.items()}
    return _with_look(scene, track, new, ref)


def _recolour(scene: Scene, edit: Recolour, shelf: CarShelf, around: Surroundings) -> Scene:
    track, boxes = _boxes(scene, edit)
    ref = _drawable(track, edit).car
    assert ref is not None
    other = _car(scene, edit, shelf) if edit.car is not None else None
    try:
        new = recolour_car(shelf, ref, way=edit.way, colour=edit.colour, other=other, amount=edit.amount)
    except InputError as error:
        raise _FieldError("colour", str(error)) from error
    return _with_look(scene, track, boxes, new)


def _with_look(scene: Scene, track: Track, boxes: dict[int, PlacedBox], ref: CarRef) -> Scene:
    """The track drawn as another car in the frames of `boxes`; the other frames keep the old one."""
    if set(boxes) == set(track.boxes):
        return scene.with_track(replace(redrawn(track, boxes), car=ref))
    name = f"{track.track_id}.{as_ranges(boxes).replace(', ', '_')}"[:90]
    number, free = 1, name
    while free in scene.tracks:
        number, free = number + 1, f"{name}_{number}"
    labels = {index: label for index, label in track.labels.items() if index in boxes}
    part = Track(track_id=free, type=track.type, boxes=boxes, car=ref, is_drawn=True, labels=labels)
    return scene.with_track(without_boxes(track, set(boxes))).with_track(part)


def _trajectory(scene: Scene, edit: Trajectory, shelf: CarShelf, around: Surroundings) -> Scene:
    track = _drawable(_track(scene, edit), edit)
    if not track.boxes:
        raise _FieldError("track", f"track {track.track_id} has no box at all; insert it anew")
    size = track.boxes[min(track.boxes)].size
    own = dict(track.boxes)
    boxes = boxes_along(edit.poses, edit.frame, _driven(scene, edit), size, scene, around, own=own)
    return scene.with_track(redrawn(track, boxes))


def _car(scene: Scene, edit: Any, shelf: CarShelf) -> CarRef:
    try:
        return find_car(scene, shelf, edit.car)
    except InputError as error:
        raise _FieldError("car", str(error)) from error


_DO: dict[type[Edit], Callable[[Scene, Any, CarShelf, Surroundings], Scene]] = {
    Insert: _insert,
    Move: _move,
    Rotate: _rotate,
    Resize: _resize,
    Delete: _delete,
    Replace: _replace,
    Recolour: _recolour,
    Trajectory: _trajectory,
}


def warnings_of(before: Scene, after: Scene, around: Surroundings) -> list[str]:
    """What looks wrong with the tracks that the edits changed: off the ground, in another, out of view."""
    found = []
    for name, track in after.tracks.items():
        old = before.tracks.get(name)
        changed = {i for i, box in track.boxes.items() if old is None or old.boxes.get(i) != box}
        if not changed:
            continue
        frames = {index: after.frame(index) for index in changed}
        off, seen, hits = [], [], dict[str, list[int]]()
        for index in sorted(changed):
            box, frame = track.boxes[index], frames[index]
            x, y, z = standing(box).tolist()
            if abs(y - around.terrain.height(frame, x, z)) > _OFF_GROUND_M:
                off.append(index)
            if is_in_view(box, frame):
                seen.append(index)
            for other in colliding(after, track, index):
                hits.setdefault(other, []).append(index)
        if off:
            found.append(f"track {name}: off the ground by more than {_OFF_GROUND_M} m in frames {as_ranges(off)}")
        found += [f"track {name}: stands in track {other} in frames {as_ranges(at)}" for other, at in hits.items()]
        if len(seen) < len(changed):
            found.append(f"track {name}: out of view in frames {as_ranges(changed - set(seen))}")
    return found


def colliding(scene: Scene, track: Track, index: int) -> list[str]:
    """Ids of the other tracks whose boxes a track's box overlaps in a frame."""
    others = ((name, other.boxes.get(index)) for name, other in sorted(scene.tracks.items()) if name != track.track_id)
    return [name for name, box in others if box is not None and collide(track.boxes[index], box)]
