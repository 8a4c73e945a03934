"""Files are whole or absent, equal values give equal bytes, and a name from a data file stays in its folder."""

import errno
import hashlib
import json
import os
import stat
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from carstudio.errors import InputError, StorageError
from carstudio.files import (
    atomic_path,
    inside,
    is_partial,
    parse_json,
    read_json,
    remove_partials,
    require_writable,
    sha256_file,
    write_bytes,
    write_json,
    write_text,
)


def test_what_is_written_is_read(tmp_path):
    write_bytes(tmp_path / "deep" / "er" / "a.bin", b"\x00\xff")
    write_text(tmp_path / "a.txt", "Rückfahrkamera")
    assert (tmp_path / "deep" / "er" / "a.bin").read_bytes() == b"\x00\xff"
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "Rückfahrkamera"


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "a.txt") as partial:  # noqa: PT012
        partial.write_text("half of the n")
        raise RuntimeError
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


def test_until_the_block_ends_the_old_file_stands(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with atomic_path(tmp_path / "a.txt") as partial:
        partial.write_text("new")
        assert partial.parent == tmp_path  # the same file system, so that the rename is atomic
        assert partial.suffix == ".txt"  # writers that go by the suffix work
        assert (tmp_path / "a.txt").read_text() == "old"
    assert (tmp_path / "a.txt").read_text() == "new"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_kill_in_the_middle_leaves_the_old_file(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    program = (
        "import os, signal, sys; from carstudio.files import atomic_path\n"
        "with atomic_path(sys.argv[1]) as p:\n"
        "    p.write_text('half'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.txt")], check=False)
    assert ended.returncode != 0
    assert (tmp_path / "a.txt").read_text() == "old"


def test_what_the_system_refuses_names_the_file_and_leaves_the_old_one(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(StorageError) as refused, atomic_path(tmp_path / "a.txt"):
        raise OSError(errno.ENOSPC, "pyarrow's words for it")
    assert f"{tmp_path / 'a.txt'}: cannot be written (No space left on device)" in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    with pytest.raises(InputError, match=r"a\.txt: expected a folder, found a file"):
        require_writable(tmp_path / "a.txt" / "b.txt")
    with pytest.raises(FileNotFoundError, match=r"photo\.png"), atomic_path(tmp_path / "b.txt"):
        (tmp_path / "photos" / "photo.png").read_bytes()  # about another file: not for us to translate


def test_only_leftovers_of_ours_are_removed(tmp_path):
    names = [
        ".a-abc_1234.partial.txt",
        "deep/.b-zzzzzzzz.partial",
        "a.txt",
        ".hidden",
        ".a.partial.txt",
        "b-abc.partial",
    ]
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    remove_partials(tmp_path)
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) == sorted(names[2:])
    require_writable(tmp_path / "a.txt")
    assert is_partial(tmp_path / ".a-abc_1234.partial.txt")


@pytest.mark.skipif(os.name != "posix", reason="permission bits")
@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_files_get_the_permissions_the_user_asked_for(tmp_path, mask):
    old = os.umask(mask)
    try:
        write_text(tmp_path / "a.txt", "x")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o666 & ~mask


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(JSON)
def test_json_comes_back_as_it_went(tmp_path_factory, value):
    path = tmp_path_factory.mktemp("json") / "value.json"
    write_json(path, value)
    assert read_json(path) == value == json.loads(path.read_bytes())


def test_equal_values_give_equal_bytes(tmp_path):
    write_json(tmp_path / "a.json", {"b": 1, "a": [1, 2]})
    write_json(tmp_path / "b.json", {"a": [1, 2], "b": 1})
    assert sha256_file(tmp_path / "a.json") == sha256_file(tmp_path / "b.json")


def test_numbers_that_json_does_not_know_are_refused(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"psnr": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe{}", b"[1, 2"])
def test_what_is_not_json_is_named(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.json: expected JSON"):
        read_json(tmp_path / "a.json")


def test_a_missing_json_is_named(tmp_path):
    with pytest.raises(InputError, match=r"absent\.json: cannot be read \(No such file"):
        read_json(tmp_path / "absent.json")
    with pytest.raises(InputError, match="cannot be read"):
        read_json(tmp_path)


def test_sha256_is_that_of_the_bytes(tmp_path):
    (tmp_path / "empty").touch()
    assert sha256_file(tmp_path / "empty") == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    data = bytes(range(256)) * 5000
    write_bytes(tmp_path / "a", data)
    assert sha256_file(tmp_path / "a") == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("name", ["a.png", "patch/a.png", "./a.png", "patch/../a.png", "...png"])
def test_names_below_the_folder_pass(tmp_path, name):
    assert inside(tmp_path, name).is_relative_to(tmp_path.resolve())


@pytest.mark.parametrize("name", ["../a.png", "patch/../../a.png", "/etc/passwd", "..", "a\0b"])
def test_names_that_climb_out_are_refused(tmp_path, name):
    (tmp_path / "patch").mkdir()
    with pytest.raises(InputError, match="expected a path below"):
        inside(tmp_path, name)


def test_links_that_lead_out_are_refused(tmp_path):
    folder = tmp_path / "store"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match="leaves its folder"):
        inside(folder, "link/secret.png")


def test_a_sibling_with_the_same_beginning_is_outside(tmp_path):
    (tmp_path / "store").mkdir()
    with pytest.raises(InputError, match="leaves its folder"):
        inside(tmp_path / "store", "../store-other/a.png")


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, "9" * 10_000, b"\xff\xfe\x00", "{'a': 1}"])
def test_json_that_no_file_of_ours_holds_is_the_users_error(text, tmp_path):
    with pytest.raises(InputError, match="here: expected JSON, found"):
        parse_json(text, name="here")
