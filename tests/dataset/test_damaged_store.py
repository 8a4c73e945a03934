"""Damage that fuzzing showed to end in a traceback: each is one message that names the file."""

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from carstudio.dataset.manifest import read_manifest
from carstudio.dataset.store import open_store
from carstudio.errors import InputError
from training.toy import toy_store


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    toy_store(tmp_path / "s", cars=1, views=2)
    return tmp_path / "s" / "data" / "part-00000.parquet"


def test_a_shard_damaged_inside_is_named_when_it_is_read(shard: Path) -> None:
    data = bytearray(shard.read_bytes())
    data[4:2000] = bytes(1996)  # pages of the first columns, the footer stays whole
    shard.write_bytes(data)
    with pytest.raises(InputError, match=r"part-00000\.parquet: expected a whole Parquet file, found a damaged one"):
        open_store(shard.parents[1]).patch_ids()
    assert any("sha256 differs" in problem for problem in open_store(shard.parents[1]).verify())


def test_a_shard_without_a_column_is_named(shard: Path) -> None:
    table = pq.read_table(shard)
    pq.write_table(table.drop_columns(["frame_path"]), shard)
    with pytest.raises(InputError, match="column 'frame_path' must be string, found none"):
        len(open_store(shard.parents[1]))


def test_a_column_of_another_type_is_named(shard: Path) -> None:
    table = pq.read_table(shard)
    place = table.schema.get_field_index("fx")
    pq.write_table(table.set_column(place, "fx", pa.array(["wide"] * len(table))), shard)
    with pytest.raises(InputError, match="column 'fx' must be double, found string"):
        len(open_store(shard.parents[1]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_patches": -1}, "num_patches must be 0 or more, found -1"),
        ({"num_patches": "2"}, "num_patches must be 0 or more, found '2'"),
        ({"name": "../../etc/passwd"}, "expected the name of a file in data/"),
        ({"sha256": 7}, "sha256 must be 64 hexadecimal digits, found 7"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_manifest_with_an_impossible_shard_is_refused(shard: Path, change: dict[str, object], message: str) -> None:
    path = shard.parents[1] / "manifest.json"
    content = json.loads(path.read_text())
    content["shards"][0] |= change
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="broken manifest") as caught:
        read_manifest(shard.parents[1])
    assert message in str(caught.value)
