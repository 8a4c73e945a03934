"""The edit file: YAML or JSON with `version: 1` and `edits:`, checked line by line.

YAML is read as plain values: no tags, no anchors (a few lines of them could ask for all memory).
"""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from carstudio.errors import InputError, shortened
from carstudio.files import read_bounded, write_text
from carstudio.scene.edits import OPS, AnyEdit, Edit

VERSION = 1
MAX_FILE_BYTES = 2**24
_DEEPEST = 12  # an edit file is four deep
_FIELDS = {
    "insert": ("car", "track", "frames", "frame", "poses", "size_m"),
    "move": ("track", "frames", "translation_m", "frame"),
    "rotate": ("track", "frames", "yaw_deg", "frame"),
    "resize": ("track", "frames", "size_m", "scale"),
    "delete": ("track", "frames"),
    "replace": ("track", "frames", "car", "size_m"),
    "recolour": ("track", "frames", "colour", "way", "car", "amount"),
    "trajectory": ("track", "frames", "frame", "poses"),
}
_POSE_FIELDS = ("at", "position_m", "yaw_deg")
Path_ = tuple[str | int, ...]


def read_edit_file(path: Path | str) -> list[Edit]:
    """The edits of a file, in order; `InputError` names file, line, what was found and the nearest valid name."""
    path = Path(path)
    data = read_bounded(path, "edit file", max_bytes=MAX_FILE_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected an edit file (YAML or JSON, UTF-8), found binary data") from error
    return parse_edits(text, name=path.name)


def parse_edits(text: str, *, name: str) -> list[Edit]:
    """The edits of a text; `name` stands in messages."""
    lines: dict[Path_, int] = {}
    value = _plain(_compose(text, name), (), lines, name)
    if not isinstance(value, dict):
        raise InputError(f"{name} line 1: expected 'version: 1' and 'edits:', found {shortened(value)}")
    version = value.get("version")
    if version != VERSION or isinstance(version, bool):
        line = lines.get(("version",), 1)
        raise InputError(f"{name} line {line}: expected version: {VERSION}, found {version!r}; update carstudio")
    for key in value:
        if key not in ("version", "edits"):
            raise InputError(f"{name} line {lines[(key,)]}: unknown field {key!r}{_nearest(key, ('version', 'edits'))}")
    entries = value.get("edits")
    if not isinstance(entries, list):
        raise InputError(f"{name} line {lines.get(('edits',), 1)}: edits must be a list, found {shortened(entries)}")
    return [_edit(entry, index, lines, name) for index, entry in enumerate(entries)]


def write_edits(path: Path, edits: Sequence[Edit]) -> None:
    """An edit file (YAML) that says the same."""
    entries = [edit.model_dump(exclude_none=True, mode="json") for edit in edits]
    for entry in entries:
        if "frames" in entry:
            entry["frames"] = "{}-{}".format(*entry["frames"])
    ordered = [{"op": entry.pop("op"), **entry} for entry in entries]
    write_text(path, yaml.safe_dump({"version": VERSION, "edits": ordered}, sort_keys=False, allow_unicode=True))


def _edit(entry: Any, index: int, lines: dict[Path_, int], name: str) -> Edit:
    at: Path_ = ("edits", index)
    op = entry.get("op") if isinstance(entry, dict) else None
    if not isinstance(op, str) or op not in OPS:
        line = lines.get((*at, "op"), lines[at])
        raise InputError(
            f"{name} line {line}: op must be one of {', '.join(OPS)}, found {shortened(op)}{_nearest(op, OPS)}"
        )
    _check_names(entry, _FIELDS[op], at, lines, name, op)
    try:
        edit: Edit = TypeAdapter(AnyEdit).validate_python(entry)
    except ValidationError as error:
        first = _clearest(error)
        inner = tuple(part for part in first["loc"] if part != op)
        said = f"{op}: {_field_name(inner)}{first['msg'].removeprefix('Value error, ')}{_found(first, inner)}"
        raise InputError(f"{name} line {_line(at, inner, lines)}: {said}") from error
    own = {str(key[2]): line for key, line in lines.items() if key[:2] == at and len(key) == 3}
    edit.came_from(name, {"op": lines[at], **own})
    return edit


def _check_names(
    entry: dict[str, Any], known: tuple[str, ...], at: Path_, lines: dict[Path_, int], name: str, op: str
) -> None:
    for key in entry:
        if key != "op" and key not in known:
            hint = _nearest(key, known) or f"; it has {', '.join(known)}"
            raise InputError(f"{name} line {lines[(*at, key)]}: {op} has no field {key!r}{hint}")
    poses = entry.get("poses")
    for number, pose in enumerate(poses if isinstance(poses, list) else ()):
        for key in pose if isinstance(pose, dict) else ():
            if key not in _POSE_FIELDS:
                hint = _nearest(key, _POSE_FIELDS) or f"; it has {', '.join(_POSE_FIELDS)}"
                line = lines[(*at, "poses", number, key)]
                raise InputError(f"{name} line {line}: a pose has no field {key!r}{hint}")


def _clearest(error: ValidationError) -> Any:
    """Of several complaints about one value (two numbers or three) the one that went deepest."""
    return max(error.errors(), key=lambda each: (len(each["loc"]), each["type"] != "missing"))


def _line(at: Path_, inner: tuple[Any, ...], lines: dict[Path_, int]) -> int:
    for length in range(len(inner), -1, -1):
        if (*at, *inner[:length]) in lines:
            return lines[(*at, *inner[:length])]
    return 1


def _field_name(inner: tuple[Any, ...]) -> str:
    parts = [str(part) for part in inner if isinstance(part, int) or not str(part).startswith(("tuple", "function"))]
    return f"{'.'.join(parts)}: " if parts else ""


def _found(error: Any, inner: tuple[Any, ...]) -> str:
    if error["type"] == "missing" or not inner:
        return ""
    return f", found {shortened(error.get('input'))}"


def nearest(word: object, known: Any, what: str) -> str:
    """`; did you mean '4'? tracks: 0, 1, 4 ...`: the end of a message about an unknown name."""
    names = [str(name) for name in known]
    hint = _nearest(word, names)
    listed = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "")
    return f"{hint or ';'} {what}: {listed or 'none'}"


def _nearest(word: object, known: Any) -> str:
    if word is None:
        return ""
    close = difflib.get_close_matches(str(word), [str(name) for name in known], n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else ""


def _compose(text: str, name: str) -> yaml.Node | None:
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark is not None else 1
        raise InputError(f"{name} line {line}: not YAML: {error.problem or error.context}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{name}: not YAML: {str(error).splitlines()[0]}") from error
    except RecursionError as error:
        raise InputError(f"{name}: not an edit file: one value in another, hundreds deep") from error


def _plain(node: yaml.Node | None, at: Path_, lines: dict[Path_, int], name: str, seen: set[int] | None = None) -> Any:
    """A node as plain values; `lines` gets the line of each value's key or item."""
    if node is None:
        return None
    seen = set() if seen is None else seen
    line = node.start_mark.line + 1
    lines.setdefault(at, line)
    if id(node) in seen or len(at) > _DEEPEST:
        raise InputError(f"{name} line {line}: anchors and aliases are not taken; write the values out")
    seen.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, (*at, number), lines, name, seen) for number, item in enumerate(node.value)]
    if isinstance(node, yaml.MappingNode):
        return _mapping(node, at, lines, name, seen)
    return _scalar(node, name, line)


def _mapping(node: yaml.MappingNode, at: Path_, lines: dict[Path_, int], name: str, seen: set[int]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        key = key_node.value if isinstance(key_node, yaml.ScalarNode) else None
        if key is None or key in result:
            raise InputError(f"{name} line {line}: {'field names are words' if key is None else f'{key!r} twice'}")
        lines[(*at, key)] = line
        result[key] = _plain(value_node, (*at, key), lines, name, seen)
    return result


_CONSTRUCTOR = yaml.SafeLoader("")
_TAGS = ("null", "bool", "int", "float", "str")


def _scalar(node: yaml.Node, name: str, line: int) -> Any:
    kind = node.tag.removeprefix("tag:yaml.org,2002:")
    if kind == "timestamp":
        return str(node.value)
    if kind not in _TAGS:
        raise InputError(f"{name} line {line}: expected a plain value, found {shortened(node.value)} ({node.tag})")
    try:
        return _CONSTRUCTOR.construct_object(node) if kind != "str" else str(node.value)
    except (ValueError, yaml.YAMLError) as error:
        raise InputError(f"{name} line {line}: expected a number, found {shortened(node.value)}") from error
