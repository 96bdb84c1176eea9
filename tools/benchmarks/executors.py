"""Who works on the cases: this process, processes of this machine, or the workers of a cluster.

Each yields ``(number of the task, answer)`` as answers come. A case follows from its name and seed, so who made it
leaves no trace in its rows; only times differ. Workers are given a task and give its rows back: they need not share a
disk with the process that keeps the results.
"""

from __future__ import annotations

import warnings
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

import elpd
from benchmarks.cases import GENERATION
from elpd.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Sequence

    Run = Callable[[Any], Any]

EXECUTORS = ("joblib", "dask", "serial")

CONNECT_S = 20
"""How long a scheduler may take to answer."""


def spread(
    run: Run, tasks: Sequence[Any], executor: str, jobs: int, scheduler: str | None = None
) -> Generator[tuple[int, Any]]:
    """Yield the number and the answer of every task, in no particular order.

    *scheduler* is the address of a dask scheduler; without one, ``dask`` starts *jobs* workers on this machine.
    Raises ``UsageError`` where an executor's package is missing or its workers cannot do this work.
    """
    if executor == "dask":
        yield from _dask(run, tasks, jobs, scheduler)
    elif executor == "serial" or jobs == 1:
        yield from (_numbered(run, one) for one in enumerate(tasks))
    else:
        yield from _joblib(run, tasks, jobs)


def _numbered(run: Run, task: tuple[int, Any]) -> tuple[int, Any]:
    return task[0], run(task[1])


def _joblib(run: Run, tasks: Sequence[Any], jobs: int) -> Iterator[tuple[int, Any]]:
    try:
        from joblib import Parallel, delayed  # type: ignore[import-untyped]  # noqa: PLC0415  (optional)
    except ImportError:
        raise UsageError("joblib is not installed; pip install 'elpd[test]', or --executor serial") from None
    calls = (delayed(_numbered)(run, one) for one in enumerate(tasks))
    answers = Parallel(n_jobs=jobs, return_as="generator_unordered")(calls)
    try:
        for answer in answers:  # noqa: UP028  (`yield from` would close it outside the filter below)
            yield answer
    finally:
        with warnings.catch_warnings():
            # Who interrupts a run knows that it was not finished.
            warnings.simplefilter("ignore", UserWarning)
            answers.close()


def _dask(run: Run, tasks: Sequence[Any], jobs: int, scheduler: str | None) -> Iterator[tuple[int, Any]]:
    try:
        from distributed import Client, LocalCluster, as_completed  # noqa: PLC0415  (optional)
    except ImportError:
        raise UsageError("dask.distributed is not installed; pip install 'elpd[cluster]'") from None
    with ExitStack() as opened:
        if scheduler is None:
            # One thread each: OpenCV and FFTs share a processor badly. Any free port for the page: 8787 may be taken.
            cluster = LocalCluster(
                n_workers=jobs, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
            )
            client = opened.enter_context(Client(opened.enter_context(cluster)))
        else:
            try:
                client = opened.enter_context(Client(scheduler, timeout=CONNECT_S))
            except (OSError, TimeoutError, ValueError) as error:
                raise UsageError(
                    f"no dask scheduler at {scheduler} within {CONNECT_S} s ({error}); start one with `dask scheduler`"
                ) from None
        _check_workers(client)
        waiting = client.map(partial(_numbered, run), list(enumerate(tasks)), pure=False)
        done = as_completed(waiting)
        waiting = None  # so that an answer that was taken is forgotten by the scheduler
        for future in done:
            yield future.result()


def _check_workers(client: Any) -> None:
    """Refuse workers without this code, or with another edition of it: their rows would not be the same."""
    here = edition()
    found = client.run(edition, on_error="return")
    if not found:
        raise UsageError("the dask scheduler has no workers; start some with `dask worker ADDRESS`")
    for address, there in found.items():
        if isinstance(there, Exception):
            raise UsageError(
                f"dask worker {address} cannot run the benchmark ({there!r}); install elpd there and start it "
                "with PYTHONPATH=tools in a checkout of this version"
            )
        if there != here:
            raise UsageError(f"dask worker {address} has {there}, and this is {here}; give it the same version")


def edition() -> dict[str, Any]:
    """Return what has to be alike for rows to be alike."""
    return {"elpd": elpd.__version__, "cases": GENERATION, "numpy": np.__version__}
