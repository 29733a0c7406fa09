"""The table of a recording: a row for each frame, with what made it in its metadata.

Everything that a later run has to know about a recording is in its table: whether it is done
(``key``), what it came to (``summary``), what was wrong with it.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from selective_depth.app.console.output import make_folder
from selective_depth.app.console.tables import metadata_of, parquet_writer
from selective_depth.app.pipeline import STAGES, FrameResult, Mean, figures_of
from selective_depth.drivers.errors import OutputError

SCHEMA = 1
"""Version of the tables' columns and metadata."""
GROUP_ROWS = 1000
"""Rows held in memory, and in a row group of the file."""
_COUNT, _FLOAT, _TEXT = pa.int64(), pa.float64(), pa.string()
COLUMNS = {
    "frame": (_COUNT, "number of the frame in its recording, from 0"),
    "timestamp_us": (_COUNT, "its time, microseconds"),
    "samples": (_COUNT, "measurements that returned depth, seeds included"),
    "shots": (_COUNT, "measurements spent beyond the seeds; with a memory, all of the frame"),
    "depth_percent": (_FLOAT, "pixels of the frame that have depth"),
    "measured_percent": (_FLOAT, "pixels measured in this frame, seeds included"),
    "known_percent": (_FLOAT, "pixels that the memory knows"),
    "neural_gas_percent": (_FLOAT, "pixels that the neural gas selects"),
    "improvement_percent": (_FLOAT, "pixels that the improvement map selects"),
    "quantisation_error_mm": (_FLOAT, "mean distance of a seed to its node"),
    "rmse_mm": (_FLOAT, "root mean square error of the model against the full frame"),
    "mae_mm": (_FLOAT, "mean absolute error of the model against the full frame"),
    "truth_rmse_mm": (_FLOAT, "as rmse_mm, against the exact depth of a made scene"),
    "sensor_rmse_mm": (_FLOAT, "of the full frame against the exact depth"),
    "even_rmse_mm": (_FLOAT, "as rmse_mm, of an even lattice of as many measurements, every 10th frame"),
    **{f"{stage}_ms": (_FLOAT, f"time of the stage {stage}") for stage in STAGES if stage != "log"},
}
"""Name of each column: its type and what it says; what was not made of a frame is null."""
MEANS = [name for name in COLUMNS if name not in ("frame", "timestamp_us")]
SUMMARY = {
    "recording": (_TEXT, "its name below --out"),
    "source": (_TEXT, "what was opened"),
    "state": (_TEXT, "whole; damaged: rows up to the damage; failed: no row"),
    "frames": (_COUNT, "rows of its table"),
    "width": (_COUNT, "of a frame, pixels"),
    "height": (_COUNT, "of a frame, pixels"),
    "fps": (_FLOAT, "nominal frame rate"),
    "colour": (pa.bool_(), "whether its frames carry colour"),
    "bytes": (_COUNT, "size of the recording"),
    "work_s": (_FLOAT, "time that it took one worker"),
    **{name: (_FLOAT, f"mean: {COLUMNS[name][1]}") for name in MEANS},
    "failure": (_TEXT, "what is wrong with it"),
}
"""The same of the summary, with a row for each recording."""


def schema_of(columns: dict[str, tuple[pa.DataType, str]]) -> pa.Schema:
    """The columns as Arrow has them, each with what it says in its metadata."""
    return pa.schema([pa.field(name, kind, metadata={"about": about}) for name, (kind, about) in columns.items()])


def row_of(result: FrameResult) -> dict[str, float | None]:
    """A frame's row."""
    times = {f"{stage}_ms": value for stage, value in result.stages_ms.items()}
    row = {"frame": result.frame.index, "timestamp_us": result.frame.timestamp_us, **figures_of(result), **times}
    return {name: value if math.isfinite(value := row.get(name, math.nan)) else None for name in COLUMNS}


class FigureTable:
    """A table under way; use `writing`.

    Attributes
    ----------
    rows : int
        How many it has.
    """

    def __init__(self, writer: pq.ParquetWriter) -> None:
        self.rows = 0
        self._writer = writer
        self._held: list[dict[str, float | None]] = []
        self._means: defaultdict[str, Mean] = defaultdict(Mean)

    def add(self, row: dict[str, float | None]) -> None:
        """Add a frame."""
        self.rows += 1
        self._held.append(row)
        for name in MEANS:
            if (value := row[name]) is not None:
                self._means[name].add(value)
        if len(self._held) == GROUP_ROWS:
            self._flush()

    def finish(self, key: str, about: dict[str, Any]) -> dict[str, Any]:
        """Record what made it and its means; returns its row of the summary."""
        self._flush()
        means = {name: mean.value for name, mean in self._means.items() if mean.count}
        summary = dict.fromkeys(SUMMARY) | about | {"frames": self.rows} | means
        self._writer.add_key_value_metadata({"key": key, "summary": json.dumps(summary)})
        return summary

    def _flush(self) -> None:
        if self._held:
            self._writer.write_table(pa.Table.from_pylist(self._held, schema=schema_of(COLUMNS)))
            self._held.clear()


@contextmanager
def writing(path: Path, settings: dict[str, Any]) -> Iterator[FigureTable]:
    """Write the table of a recording; if it has no row, no file is left, not even an older one."""
    make_folder(path.parent)
    schema = schema_of(COLUMNS).with_metadata({"settings": json.dumps(settings)})
    try:
        with parquet_writer(path, schema, SCHEMA) as writer:
            yield (table := FigureTable(writer))
            if not table.rows:
                raise _NoRowError
    except _NoRowError:
        path.unlink(missing_ok=True)


class _NoRowError(Exception):
    """Nothing to keep."""


def found_done(path: Path, key: str) -> dict[str, Any] | None:
    """The summary row of an existing table, if it was made with this key.

    Raises
    ------
    OutputError
        If what is there is not a table of `batch`, or was written by a newer version.
    """
    if not path.exists():
        return None
    said = metadata_of(path)
    if said is None or "key" not in said:
        raise OutputError(
            f"'{path}' is not a table that batch wrote; move it away, name another --out, or replace it with --force."
        )
    if int(said["schema"]) > SCHEMA:
        raise OutputError(
            f"'{path}' has schema {said['schema']}, of selective-depth {said['version']}; this version reads"
            f" {SCHEMA} and older. Update it, name another --out, or replace it with --force."
        )
    return json.loads(said["summary"]) if said["key"] == key else None


def rows_of(path: Path) -> Iterator[dict[str, float | None]]:
    """The rows of a table, read piece by piece."""
    with pq.ParquetFile(path) as file:
        for batch in file.iter_batches(GROUP_ROWS):
            yield from batch.to_pylist()
