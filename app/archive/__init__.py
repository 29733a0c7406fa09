"""Many recordings on Dask: units of work, their tables, and the engine that spreads them."""

from selective_depth.app.archive.batch import SUMMARY_FILE, Batch, recordings
from selective_depth.app.archive.engine import Stream, dashboard, engine
from selective_depth.app.archive.table import FigureTable, row_of, writing
from selective_depth.app.archive.unit import Job, Keeper, Recording

__all__ = [
    "SUMMARY_FILE",
    "Batch",
    "FigureTable",
    "Job",
    "Keeper",
    "Recording",
    "Stream",
    "dashboard",
    "engine",
    "recordings",
    "row_of",
    "writing",
]
