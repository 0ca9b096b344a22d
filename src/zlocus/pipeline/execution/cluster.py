"""Workers of a Dask cluster. `distributed` must be installed here, and zlocus on the workers."""

from __future__ import annotations

import gc
import pickle
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from zlocus.core.errors import ConfigError, StoppedError
from zlocus.core.startup import allow_import
from zlocus.pipeline.execution.processes import one_thread
from zlocus.pipeline.execution.tasks import Cause, Failure, Outcome, attempted, failure_of

P = ParamSpec("P")
R = TypeVar("R")
CONNECT_S, WORKERS_S = 10.0, 120.0
CHECK_INTERVAL_S = 5.0  # between two checks whether the cluster has workers
# Tasks queued at each worker, so that it does not wait while results are sent.
QUEUED_TASKS = 1
# Functions of the runs that this worker takes part in, by the name of the run.
_functions: dict[str, Callable[[Any], Any]] = {}


def begin(name: str, function: bytes) -> None:
    """Register the function of a run; called on a worker before its first task."""
    one_thread()
    _functions[name] = pickle.loads(function)


def end(name: str) -> None:
    """Forget the function of a run; called on a worker when the run ends."""
    _functions.pop(name, None)


def at_worker(name: str, task: Any) -> Outcome:
    """Try a task once; called on a worker."""
    from distributed import get_worker

    return attempted(_functions[name], task, get_worker().address, time.thread_time(), time.thread_time)


class Cluster:
    """Workers of the Dask cluster whose scheduler listens at an address.

    When a worker is lost, the cluster gives its tasks to others. Leaving the context removes the tasks and the function
    of this run from the cluster, which keeps running.

    Raises
    ------
    ConfigError
        `distributed` is not installed, or nothing answers at the address, or the cluster has no workers.
    """

    def __init__(self, function: Callable[[Any], Any], address: str) -> None:
        self._address, self._name = address, f"zlocus-{uuid.uuid4().hex}"
        self._client = _client(address)
        self._futures: dict[Any, Any] = {}
        self._calls = ThreadPoolExecutor(1, "calls to the cluster")
        try:
            self._call(self._client.wait_for_workers, 1, WORKERS_S)
            self._call(self._client.register_plugin, _plugin(self._name, pickle.dumps(function)), self._name)
        except TimeoutError as error:
            self.close()
            raise ConfigError(
                f"The cluster at {address} has no workers after {WORKERS_S:.0f} s. Start some (dask worker {address})."
            ) from error
        except (KeyboardInterrupt, SystemExit):
            self.close()
            raise
        except Exception as error:
            self.close()
            raise ConfigError(
                f"The workers of {address} cannot do the run: {' '.join(str(error).split()) or type(error).__name__}. "
                "Install the same versions of Python and zlocus there."
            ) from error

    @property
    def dashboard(self) -> str:
        """Address of the web page on which the cluster shows its work."""
        return str(self._client.dashboard_link)

    @property
    def slots(self) -> int:
        """See `Workers`; the number follows the size of the cluster."""
        with self._reached():
            threads = [int(n) for n in self._call(self._client.nthreads).values()]
        return max(sum(threads) + QUEUED_TASKS * len(threads), 1)

    def submit(self, task: Any) -> None:
        """See `Workers`."""
        key = f"{self._name}-{uuid.uuid4().hex}"
        with self._reached():
            self._futures[self._client.submit(at_worker, self._name, task, key=key, pure=False)] = task

    def wait(self) -> list[Outcome]:
        """See `Workers`.

        Raises
        ------
        StoppedError
            The scheduler has gone, or the cluster has had no workers for some time.
        """
        without_workers_s = 0.0
        while True:
            with self._reached():
                try:
                    return self._call(_finished, self._futures)
                except TimeoutError:
                    has_workers = bool(self._call(self._client.nthreads))
                    without_workers_s = 0.0 if has_workers else without_workers_s + CHECK_INTERVAL_S
            if without_workers_s >= WORKERS_S:
                raise StoppedError(
                    f"The cluster at {self._address} has had no workers for {WORKERS_S:.0f} s. Finished tiles are "
                    "kept: give the same command again when it has some."
                )

    @contextmanager
    def _reached(self) -> Iterator[None]:
        try:
            yield
        except TimeoutError:  # an OSError
            raise
        except (OSError, CancelledError) as error:
            raise StoppedError(
                f"The scheduler at {self._address} has gone. Finished tiles are kept: give the same command again "
                "when it is back, or without --scheduler."
            ) from error

    def _call(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call a function of `distributed` in a thread, where no signal interrupts it: when it is interrupted as it
        begins, `distributed` prints a traceback."""
        return self._calls.submit(function, *args, **kwargs).result()

    def close(self) -> None:
        """Remove the remaining tasks of the run from the cluster."""
        with suppress(Exception):  # a scheduler that has gone has nothing left
            self._client.cancel(list(self._futures), force=True)
            self._client.unregister_worker_plugin(self._name)
        with suppress(Exception):
            self._client.close(timeout=CONNECT_S)
        self._calls.shutdown(wait=False, cancel_futures=True)

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _client(address: str) -> Any:
    """A client of the scheduler that listens at an address.

    Raises
    ------
    ConfigError
        `distributed` is not installed, or nothing answers.
    """
    allow_import("dask")
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError("--scheduler needs distributed, which is not installed: pip install distributed.") from error
    try:
        return Client(address, timeout=CONNECT_S)
    except (OSError, ValueError) as error:  # timeouts are among the first
        said = str(error) or type(error).__name__
    # A client that found nobody closes itself when it is collected. Were it collected while another one starts, both
    # would wait for one lock of `distributed` without end. The error would keep it: it is not chained.
    gc.collect()
    raise ConfigError(
        f"--scheduler {address} does not answer: {said}. Give the address that the Dask scheduler prints, such as "
        "tcp://10.0.0.1:8786."
    )


def _finished(futures: dict[Any, Any]) -> list[Outcome]:
    """The outcomes of futures that have ended, which are removed from those that are waited for; at least one.

    futures : the task of each.

    Raises
    ------
    TimeoutError
        None has ended within `CHECK_INTERVAL_S`.
    """
    from distributed import wait

    outcomes = []
    for future in wait(list(futures), timeout=CHECK_INTERVAL_S, return_when="FIRST_COMPLETED").done:
        error, task = future.exception(), futures.pop(future)
        outcomes.append(future.result() if error is None else _failed(task, error))
        future.release()
    return outcomes


def _failed(task: Any, error: Exception) -> Outcome:
    if type(error).__name__ == "KilledWorker":
        said = "workers that had it were lost, one after another"
        return Outcome(task, failure=Failure(Cause.LOST, said, is_given_up=True))
    return Outcome(task, failure=failure_of(error))


def _plugin(name: str, function: bytes) -> Any:
    """Plugin that sends the function of a run to every worker, also to those that join later."""
    from distributed import WorkerPlugin

    class Plugin(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            begin(name, function)

        def teardown(self, worker: Any) -> None:
            end(name)

    return Plugin()
