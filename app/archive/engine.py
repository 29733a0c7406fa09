"""Dask distributed: a cluster of this machine's processors for as long as it is needed, or one that is there.

The only module that imports it; it is an optional extra.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from selective_depth.app.console import interrupt
from selective_depth.app.console.errors import AppError, UsageError
from selective_depth.app.console.progress import waiting
from selective_depth.selectors.parallel import default_threads

if TYPE_CHECKING:
    from distributed import Client, Future

PATIENCE_S = 10.0
"""How long a scheduler may take to answer."""
TOPIC = "selective-depth"
_LOGGED = {"logging": dict.fromkeys(("distributed", "tornado", "asyncio", "bokeh"), "critical")}
"""What Dask logs; what is worth a line is said by this program."""
_QUIET = {
    # Dask's default makes malloc return memory to the system that the next frame needs again.
    "distributed.nanny.pre-spawn-environ": {f"{each}_NUM_THREADS": 1 for each in ("OMP", "MKL", "OPENBLAS")},
    "distributed.comm.timeouts.connect": f"{PATIENCE_S:g}s",
}
_WORKERS = {
    "LOGGING__DISTRIBUTED": "critical",  # what matters comes as a result
    # Looking at itself so often costs a worker some percent of its time.
    "DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
    "DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
}


@contextmanager
def engine(scheduler: str | None = None, workers: int | None = None) -> Iterator[Client]:
    """A client of a cluster.

    Parameters
    ----------
    scheduler : str, optional
        Address of a scheduler, ``tcp://host:8786``, or the file that it writes; by default a
        cluster of processes on this machine, with one kernel thread each, that ends with the client.
    workers : int, optional
        How many processes; default one per processor.

    Raises
    ------
    AppError
        If Dask is not installed, or the scheduler does not answer.
    """
    if importlib.util.find_spec("distributed") is None:
        raise AppError("this needs Dask, which is not installed: pip install 'selective-depth[batch]'.")
    for name, value in _WORKERS.items():  # read when Dask is imported, here and in the workers
        os.environ.setdefault(f"DASK_{name}", value)
    import dask

    # What is logged is read on importing it. The rest is set after that: what is set before takes all of Dask's own
    # settings with it when it is undone, from under threads that are still ending.
    with dask.config.set(_LOGGED):
        from distributed import Client
    with dask.config.set(_QUIET):
        if scheduler is not None:
            client = _there(scheduler)
        else:
            with interrupt.started_deaf(), waiting("Starting the workers"):
                client = Client(
                    n_workers=workers or default_threads(),
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",
                    env={"SELECTIVE_DEPTH_THREADS": "1"},
                )
        done = False
        try:
            yield client
            done = True
        finally:
            if scheduler is not None:
                client.close(timeout=1)
            elif done:
                client.close()
            else:  # after Ctrl-C, say: what is under way is not waited for
                for process in multiprocessing.active_children():
                    process.kill()


def _there(scheduler: str) -> Client:
    """A client of a cluster that is there."""
    from distributed import Client

    file = Path(scheduler).is_file()
    if not file and "://" not in scheduler:
        raise UsageError(
            f"--scheduler is '{scheduler}'; it must be an address, such as tcp://host:8786, or the file that"
            " 'dask scheduler --scheduler-file FILE' writes."
        )
    try:
        return Client(**({"scheduler_file": scheduler} if file else {"address": scheduler}))
    except (OSError, ValueError) as error:
        raise AppError(f"no scheduler answers at '{scheduler}' ({error}); start one with 'dask scheduler'.") from error


def dashboard(client: Client) -> str:
    """Address of the page that shows the cluster at work; empty where there is none."""
    return client.dashboard_link if importlib.util.find_spec("bokeh") else ""


class Stream:
    """Calls under way on a cluster, a window's worth of them at a time, and their results as they come.

    Parameters
    ----------
    client : Client
        Of the cluster.
    heard : callable
        Called, in another thread, with what the functions `tell`.
    """

    def __init__(self, client: Client, heard: Callable[[Any], None]) -> None:
        self._client = client
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._under_way: dict[str, tuple[Future, Any]] = {}
        self._looked_s = -PATIENCE_S
        self.workers = 0
        client.subscribe_topic(TOPIC, lambda event: heard(event[1]))

    def __len__(self) -> int:
        return len(self._under_way)

    @property
    def full(self) -> bool:
        """Whether there is enough under way to keep the workers busy."""
        if time.monotonic() - self._looked_s > 2:
            self._looked_s, self.workers = time.monotonic(), sum(self._client.nthreads().values())
        return len(self._under_way) >= 2 * max(self.workers, 1) + 2

    def submit(self, function: Callable[..., Any], *arguments: Any, tag: Any) -> None:
        """Begin a call; `tag` comes back with its result."""
        future = self._client.submit(function, *arguments, pure=False)
        self._under_way[future.key] = future, tag
        future.add_done_callback(self._done.put)

    def finished(self, timeout_s: float) -> Iterator[tuple[Any, Any]]:
        """What is done by now, or the first within some seconds: tags with their results, or with the exceptions."""
        some: list[Future] = []
        with suppress(queue.Empty):
            some.append(self._done.get(timeout=timeout_s))
            while True:
                some.append(self._done.get_nowait())
        good = [future for future in some if future.status == "finished"]
        results: dict[str, Any] = {}
        with suppress(Exception):  # a worker is gone with a result: it is asked for again, below
            results = dict(zip((future.key for future in good), self._client.gather(good), strict=True))
        for future in some:
            _, tag = self._under_way.pop(future.key)
            try:
                yield tag, results[future.key] if future.key in results else future.result()
            except Exception as error:  # noqa: BLE001 - what it means is the caller's to say
                yield tag, error


def tell(what: Any) -> None:
    """Tell the client how far a call on a worker has come; does nothing elsewhere."""
    from distributed import get_worker

    with suppress(ValueError):
        get_worker().log_event(TOPIC, what)
