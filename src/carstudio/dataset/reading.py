"""What goes wrong when a Parquet file is read, as the user's error."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa

from carstudio.errors import InputError


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """`InputError` naming the file when what is read in the block is damaged, or no Parquet at all."""
    try:
        yield
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{path}: expected a whole Parquet file, found a damaged one or something else ({first}); restore it, or "
            "build the store again"
        ) from error
