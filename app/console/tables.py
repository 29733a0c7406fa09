"""Parquet files that say what made them: written whole or not at all, read back with care."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from selective_depth.app import __version__
from selective_depth.app.console.output import replacing


@contextmanager
def parquet_writer(path: Path, schema: pa.Schema, version: int) -> Iterator[pq.ParquetWriter]:
    """Write a Parquet file piece by piece; it takes its name when it is whole.

    Parameters
    ----------
    path : Path
        The file; an older one is replaced at the end.
    schema : pyarrow.Schema
        Its columns.
    version : int
        Of the schema; goes into the metadata as ``schema``, beside the program's ``version``.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    stamp = {"schema": str(version), "version": __version__}
    # Its own footer is written on closing: before the file takes its name.
    with (
        replacing(path) as file,
        pq.ParquetWriter(file, schema.with_metadata((schema.metadata or {}) | stamp), compression="zstd") as writer,
    ):
        yield writer


def write_table(path: Path, table: pa.Table, version: int) -> None:
    """Write a table whole or not at all, as CSV or Parquet by the file's ending."""
    if path.suffix.lower() == ".csv":
        with replacing(path) as file:
            pyarrow.csv.write_csv(table, file)
        return
    with parquet_writer(path, table.schema, version) as writer:
        writer.write_table(table)


def metadata_of(path: Path) -> dict[str, str] | None:
    """What a Parquet file says of itself; None where it is missing or cannot be read."""
    try:
        said = pq.read_metadata(path).metadata or {}
    except (OSError, pa.ArrowException):
        return None
    return {key.decode(): value.decode() for key, value in said.items() if key != b"ARROW:schema"}
