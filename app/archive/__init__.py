"""Many recordings on Dask: units of work, their tables, and the engine that spreads them."""

from selective_depth.app.archive.batch import Batch
from selective_depth.app.archive.engine import engine
from selective_depth.app.archive.unit import Job, Keeper

__all__ = ["Batch", "Job", "Keeper", "engine"]
