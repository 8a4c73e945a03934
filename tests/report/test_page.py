"""Pages: whatever stands in a name, caption or command is shown as text; pictures are what their bytes say."""

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from carstudio.errors import InputError
from carstudio.evaluation.tables import Cell, Table
from carstudio.images import decode_image, encode_jpeg, encode_png
from carstudio.report.page import (
    Commands,
    Comparison,
    Gallery,
    KeyFigure,
    Page,
    Picture,
    Section,
    Text,
    media_type,
    render_page,
    write_page,
)
from carstudio.report.video import write_gif, write_mp4

PIXELS = np.arange(12 * 16 * 3, dtype=np.uint8).reshape(12, 16, 3)
EVIL = "</title><script>alert('1')</script><img src=x onerror=\"x()\">&amp;"


class Elements(HTMLParser):
    """What a browser would make of a page: elements with their attributes, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attributes)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]


def page_of_everything(words: str) -> Page:
    """A page on which `words` stand in every place that takes text."""
    picture = Picture(source=encode_png(PIXELS), caption=words, alt=words)
    table = Table(caption=words, columns=(words, words), rows=((Cell(words), Cell(words, "best", words)),))
    blocks = [
        Text(words),
        picture,
        Gallery([picture]),
        Comparison([words], [(words, [picture])]),
        table,
        Commands([words]),
    ]
    sections = [Section(title=words, blocks=blocks) for _ in range(4)]  # with four there is a navigation
    figure = KeyFigure(value=words, label=words, detail=words)
    return Page(title=words, lead=words, hero=picture, figures=[figure], sections=sections, footer=[(words, words)])


def test_text_is_text_wherever_it_stands(tmp_path: Path) -> None:
    evil, harmless = (Elements(render_page(page_of_everything(words), tmp_path)) for words in (EVIL, "plain"))
    assert [tag for tag, _ in evil.found] == [tag for tag, _ in harmless.found]  # no element more than without it
    assert not evil.named("script")
    assert not any(name.startswith("on") for _, attributes in evil.found for name in attributes)
    assert {image["alt"] for image in evil.named("img")} == {EVIL}
    assert evil.text.count(EVIL) == harmless.text.count("plain") > 40


def test_embedded_pictures_are_the_bytes_given(tmp_path: Path) -> None:
    for data, kind in ((encode_png(PIXELS), "image/png"), (encode_jpeg(PIXELS, quality=90), "image/jpeg")):
        page = Page(title="A", sections=[Section(title="B", blocks=[Picture(source=data)])])
        (image,) = Elements(render_page(page, tmp_path)).named("img")
        head, encoded = str(image["src"]).split(",")
        assert head == f"data:{kind};base64"
        assert base64.b64decode(encoded) == data
    assert np.array_equal(decode_image(encode_png(PIXELS), name="a"), PIXELS)


def test_moving_pictures_are_told_by_their_first_bytes(tmp_path: Path) -> None:
    write_gif(tmp_path / "a.gif", [PIXELS] * 3, 5.0)
    write_mp4(tmp_path / "a.mp4", [PIXELS] * 3, 5.0)
    assert media_type(Picture(source=(tmp_path / "a.gif").read_bytes())) == "image/gif"
    assert media_type(Picture(source=(tmp_path / "a.mp4").read_bytes())) == "video/mp4"
    section = Section(title="B", blocks=[Picture(source="a.mp4", caption="a car turning"), Picture(source="a.gif")])
    elements = Elements(render_page(Page(title="A", sections=[section]), tmp_path))
    (video,) = elements.named("video")
    assert video["src"] == "a.mp4"
    assert video["aria-label"] == "a car turning"
    assert [image["src"] for image in elements.named("img")] == ["a.gif"]


@pytest.mark.parametrize("source", [b"", b"RIFFxxxxWEBP", b"PK\x03\x04", "notes.txt", "noending"])
def test_what_is_no_picture_is_refused(source: bytes | str, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "noending").write_text("x")
    page = Page(title="A", sections=[Section(title="B", blocks=[Picture(source=source, caption="the car")])])
    with pytest.raises(InputError, match=r"expected PNG|a page shows"):
        render_page(page, tmp_path)


def test_a_refused_page_leaves_the_old_one(tmp_path: Path) -> None:
    write_page(tmp_path / "index.html", Page(title="Old"))
    with pytest.raises(InputError):
        write_page(tmp_path / "index.html", Page(title="New", hero=Picture(source="missing.png")))
    assert "Old" in (tmp_path / "index.html").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]


def test_sections_are_linked_and_every_element_is_closed(tmp_path: Path) -> None:
    text = render_page(page_of_everything("plain"), tmp_path)
    elements = Elements(text)
    assert [link["href"] for link in elements.named("a")] == [f"#section-{i}" for i in (1, 2, 3, 4)]
    assert [section["id"] for section in elements.named("section")] == [f"section-{i}" for i in (1, 2, 3, 4)]
    for tag in ("section", "figure", "table", "tr", "td", "th", "dl", "div", "pre", "main", "p"):
        assert len(elements.named(tag)) == len(re.findall(f"</{tag}>", text)), tag
