"""What goes wrong when a Parquet file is read, as the user's error."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from carstudio.errors import InputError, first_line


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """`InputError` naming the file when what is read in the block is damaged, or no Parquet at all."""
    try:
        yield
    except (pa.ArrowException, OSError, UnicodeDecodeError, OverflowError) as error:
        raise InputError(
            f"{path}: expected a whole Parquet file, found a damaged one or something else ({first_line(error)}); "
            "restore it, or build the store again"
        ) from error


def open_parquet(path: Path, schema: pa.Schema) -> pq.ParquetFile:
    """A Parquet file that has the columns of `schema`, with these types; checksums of its pages are heeded."""
    with reading(path):
        file = pq.ParquetFile(path, memory_map=True, page_checksum_verification=True)
        found = {field.name: field.type for field in file.schema_arrow}
    for field in schema:
        if found.get(field.name) != field.type:
            raise InputError(
                f"{path}: column {field.name!r} must be {field.type}, found {found.get(field.name, 'none')}; "
                "it is no such file of a CarPatch3D store, or a damaged one"
            )
    return file


def sound(table: pa.Table, required: Collection[str], path: Path) -> pa.Table:
    """The table, its text UTF-8, its offsets inside its buffers, and a value in every row of the columns `required`."""
    with reading(path):
        table.validate(full=True)
    for name in table.column_names:
        if name in required and table[name].null_count:
            raise InputError(
                f"{path}: column {name!r} must have a value in every row, found {table[name].null_count} without; "
                "restore the file, or build the store again"
            )
    return table
