"""One self-contained HTML page: what a run did, with pictures, tables and the commands that repeat it.

Pictures given as bytes are embedded, so that the page can be mailed as one file; a path names a file beside the page
(long videos). No script, nothing fetched from anywhere.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from carstudio import __version__
from carstudio.errors import InputError
from carstudio.evaluation.tables import Table, to_html
from carstudio.files import inside, write_text

# First bytes of what browsers show, and its media type. MP4 names itself four bytes in.
_SIGNATURES = (
    (0, b"\x89PNG\r\n", "image/png"),
    (0, b"\xff\xd8\xff", "image/jpeg"),
    (0, b"GIF8", "image/gif"),
    (0, b"<?xml", "image/svg+xml"),
    (0, b"<svg", "image/svg+xml"),
    (4, b"ftyp", "video/mp4"),
)


@dataclass(frozen=True, kw_only=True)
class KeyFigure:
    """A number that matters, large: value with its unit, what it is, and small print."""

    value: str
    label: str
    detail: str = ""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A still, a GIF or an MP4: encoded bytes (embedded) or a path relative to the page (POSIX, not climbing out)."""

    source: bytes | str
    caption: str = ""
    alt: str = ""  # for readers who cannot see it; the caption when empty
    pixelated: bool = False  # show a small patch enlarged with its pixels


@dataclass(frozen=True)
class Text:
    """Paragraphs of plain text, separated by empty lines."""

    text: str


@dataclass(frozen=True)
class Gallery:
    """Pictures in a grid that fills the width: columns at least `min_width_px` wide (two or more fit on a phone)."""

    pictures: Sequence[Picture]
    min_width_px: int = 150


@dataclass(frozen=True)
class Comparison:
    """Rows of pictures under common heads (input, truth, ours, ...); each row has a label."""

    heads: Sequence[str]
    rows: Sequence[tuple[str, Sequence[Picture]]]


@dataclass(frozen=True)
class Commands:
    """Shell commands as they were run, one per entry."""

    lines: Sequence[str]


Block = Text | Picture | Gallery | Comparison | Table | Commands


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading and its blocks."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True, kw_only=True)
class Page:
    """A report. `footer` lines are (name, value): seed, command, sha256 of data; the version is added."""

    title: str
    lead: str = ""  # one or two sentences below the title
    hero: Picture | None = None  # a wide picture at the top
    figures: Sequence[KeyFigure] = ()
    sections: Sequence[Section] = ()
    footer: Sequence[tuple[str, str]] = ()


def write_page(path: Path | str, page: Page) -> None:
    """Write `page` atomically as UTF-8 HTML; `InputError` when a picture named by path is not there."""
    path = Path(path)
    write_text(path, render_page(page, path.parent))


def render_page(page: Page, folder: Path) -> str:
    """The page's HTML; pictures named by path are looked for in `folder`."""
    environment = Environment(
        loader=PackageLoader("carstudio.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["source"] = lambda picture: picture_source(picture, folder)
    environment.filters["is_video"] = lambda picture: media_type(picture) == "video/mp4"
    environment.filters["table"] = lambda table: Markup(to_html(table))
    environment.filters["kind"] = lambda block: type(block).__name__
    footer = [("Car-Studio", __version__), *page.footer]
    return environment.get_template("page.html").render(page=page, footer=footer)


def media_type(picture: Picture) -> str:
    """Media type from the first bytes, or from the ending of a file's name."""
    if isinstance(picture.source, str):
        endings = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".gif": "image/gif"}
        endings |= {".svg": "image/svg+xml", ".mp4": "video/mp4"}
        ending = PurePosixPath(picture.source).suffix.lower()
        if ending not in endings:
            raise InputError(f"{picture.source}: a page shows {', '.join(endings)}, found {ending or 'no ending'}")
        return endings[ending]
    for start, signature, kind in _SIGNATURES:
        if picture.source[start : start + len(signature)] == signature:
            return kind
    raise InputError(f"picture {picture.caption!r}: expected PNG, JPEG, GIF, SVG or MP4, found other bytes")


def picture_source(picture: Picture, folder: Path) -> str:
    """What stands in the `src` attribute: a data URI, or the relative path after a look that the file is there."""
    if isinstance(picture.source, bytes):
        return f"data:{media_type(picture)};base64,{base64.b64encode(picture.source).decode()}"
    if not inside(folder, picture.source).is_file():
        raise InputError(f"{folder / picture.source}: picture of the page is not there; write it before the page")
    return picture.source
