"""Which photographs a root names: folders, patterns, lists, URLs; and what is said when there are none."""

from pathlib import Path

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carstudio.dataset.schema import check_id
from carstudio.dataset.sources.photo_files import find_photos, frame_id_of, read_photo
from carstudio.errors import InputError
from carstudio.images import encode_png

PNG = encode_png(np.zeros((4, 6, 3), np.uint8))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("b.png", "sub/c.JPG", "sub/deep/b.jpeg", "notes.md", "my car (1).jpg"):
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(PNG)
    return tmp_path / "photos"


def test_a_folder_with_all_below_it(folder: Path) -> None:
    found = find_photos(str(folder))
    assert [file.path for file in found] == ["b.png", "my car (1).jpg", "sub/c.JPG", "sub/deep/b.jpeg"]
    ids = [file.frame_id for file in found]
    assert ids[2] == "c"
    assert ids[0].startswith("b-")
    assert ids[3].startswith("sub-deep-b-")
    assert ids[1].startswith("my-car-1-")
    assert len(set(ids)) == 4
    assert [read_photo(file.location) for file in found] == [PNG] * 4


def test_a_pattern_names_files_from_their_common_folder(folder: Path) -> None:
    found = find_photos(f"{folder}/**/*.[jJ]*")
    assert [file.path for file in found] == ["my car (1).jpg", "sub/c.JPG", "sub/deep/b.jpeg"]
    assert [file.path for file in find_photos(f"{folder}/sub/*.JPG")] == ["c.JPG"]


def test_lists_keep_their_order_and_bring_facts(folder: Path) -> None:
    text = folder / "list.txt"
    text.write_text("\ufeff# mine\nsub/c.JPG\n\nb.png\n", encoding="utf-8")
    assert [(file.path, file.frame_id) for file in find_photos(str(text))] == [("sub/c.JPG", "c"), ("b.png", "b")]
    table = folder / "list.csv"
    table.write_text(f"path, instance_id, camera, licence\nb.png,car-1,500,CC0-1.0\n{folder}/sub/c.JPG,,,\n")
    first, second = find_photos(str(table))
    assert (first.instance_id, first.camera, first.licence) == ("car-1", "500", "CC0-1.0")
    assert (second.instance_id, second.camera, second.location) == (None, None, f"{folder}/sub/c.JPG")
    pq.write_table(pa.table({"path": ["sub/c.JPG", "b.png"], "instance_id": ["x", None]}), folder / "list.parquet")
    assert [file.instance_id for file in find_photos(str(folder / "list.parquet"))] == ["x", None]
    assert read_photo(first.location) == PNG


def test_urls_of_any_file_system(folder: Path) -> None:
    memory = fsspec.filesystem("memory")
    for name in ("a.png", "sub/b.png"):
        memory.pipe_file(f"/bucket/{name}", PNG)
    memory.pipe_file("/bucket/list.txt", b"sub/b.png\nmemory://bucket/a.png\n")
    assert [file.path for file in find_photos("memory://bucket")] == ["a.png", "sub/b.png"]
    assert [file.path for file in find_photos("memory://bucket/*/*.png")] == ["b.png"]
    assert [file.path for file in find_photos("memory://bucket/sub/b.png")] == ["b.png"]
    listed = find_photos("memory://bucket/list.txt")
    assert [file.path for file in listed] == ["sub/b.png", "bucket/a.png"]
    assert [read_photo(file.location) for file in listed] == [PNG, PNG]
    with pytest.raises(InputError, match=r"memory://bucket/absent\.png: cannot be read"):
        read_photo("memory://bucket/absent.png")
    with pytest.raises(InputError, match="cannot be listed"):
        find_photos("nosuchprotocol://bucket/x")


def test_what_is_no_photograph_is_said(folder: Path) -> None:
    (folder / "empty").mkdir()
    (folder / "bad.csv").write_text("file\nb.png\n")
    (folder / "twice.txt").write_text("b.png\nb.png\n")
    (folder / "binary.txt").write_bytes(b"\xff\xfe\x00\x81")
    (folder / "bad.parquet").write_bytes(b"PAR1")
    for root, message in {
        folder / "empty": "no photographs; expected files ending in .png",
        folder / "absent": "no such folder, photograph, list",
        folder / "bad.csv": r"bad\.csv row 1: expected a column path .*found \['file'\]",
        folder / "twice.txt": r"b\.png is listed twice",
        folder / "binary.txt": "expected a list as UTF-8 text, found binary data",
        folder / "bad.parquet": "expected a Parquet list",
        folder / "*.gif": "no photographs",
        folder / "absent.csv": r"list cannot be read \(No such file",
    }.items():
        with pytest.raises(InputError, match=message):
            find_photos(str(root))


@given(st.text(min_size=1, max_size=150).map(lambda text: text.replace("/", "_")), st.booleans())
def test_every_name_gives_a_safe_id(name: str, is_unique: bool) -> None:
    check_id(f"ph-{frame_id_of(f'{name}.jpg', is_unique=is_unique)}-123", "patch id")


def test_ids_of_different_paths_differ() -> None:
    names = ["a/b.jpg", "a-b.jpg", "a b.jpg", "a/b.png", "é.jpg", "è.jpg", "x" * 200 + ".jpg", "x" * 201 + ".jpg"]
    assert len({frame_id_of(name, is_unique=False) for name in names}) == len(names)
