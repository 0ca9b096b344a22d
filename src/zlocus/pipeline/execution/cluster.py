"""A Dask cluster whose workers do the tasks; needs `distributed` here and zlocus there."""

from __future__ import annotations

import pickle
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any

from zlocus.core.errors import ConfigError, StoppedError
from zlocus.core.startup import let_in
from zlocus.pipeline.execution.processes import one_thread
from zlocus.pipeline.execution.tasks import Cause, Failure, Outcome, attempted, failure_of

CONNECT_S, WORKERS_S = 10.0, 120.0
LOOK_S = 5.0  # between looks at whether there are workers
# Tasks that wait at a worker, so that it does not while results travel.
AHEAD = 1
# What workers of this process do, by the names of runs.
_functions: dict[str, Callable[[Any], Any]] = {}


def begin(name: str, function: bytes) -> None:
    """On a worker, before a run's first task."""
    one_thread()
    _functions[name] = pickle.loads(function)


def end(name: str) -> None:
    """On a worker, at the end of a run."""
    _functions.pop(name, None)


def at_worker(name: str, task: Any) -> Outcome:
    """One attempt at a task, on a worker."""
    from distributed import get_worker

    return attempted(_functions[name], task, get_worker().address, time.thread_time(), time.thread_time)


class Cluster:
    """Workers of the cluster whose scheduler listens at an address.

    A worker that is lost costs its tasks only: the cluster gives them to others. Leaving the context takes the run's
    tasks and function from the cluster, which goes on.

    Raises
    ------
    ConfigError
        `distributed` is not installed, or nothing answers at the address, or the cluster has no workers.
    """

    def __init__(self, function: Callable[[Any], Any], address: str) -> None:
        let_in("dask")
        try:
            from distributed import Client
        except ImportError as error:
            raise ConfigError(
                "--scheduler needs distributed, which is not installed: pip install '.[cluster]'."
            ) from error
        self._address, self._name = address, f"zlocus-{uuid.uuid4().hex}"
        try:
            self._client = Client(address, timeout=CONNECT_S)
        except (OSError, ValueError) as error:  # those of timeouts are among the first
            raise ConfigError(
                f"--scheduler {address} does not answer: {str(error) or type(error).__name__}. Give the address that "
                "the Dask scheduler prints, such as tcp://10.0.0.1:8786."
            ) from error
        self._futures: dict[Any, Any] = {}
        try:
            self._client.wait_for_workers(1, timeout=WORKERS_S)
            self._client.register_plugin(_plugin(self._name, pickle.dumps(function)), self._name)
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
        """Address of a page that shows what the cluster does."""
        return str(self._client.dashboard_link)

    @property
    def slots(self) -> int:
        """See `Workers`; grows and shrinks with the cluster."""
        with self._reached():
            threads = [int(n) for n in self._client.nthreads().values()]
        return max(sum(threads) + AHEAD * len(threads), 1)

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
            The scheduler has gone, or all workers have and none came back.
        """
        from distributed import wait

        alone_s = 0.0
        while True:
            with self._reached():
                try:
                    done = wait(list(self._futures), timeout=LOOK_S, return_when="FIRST_COMPLETED").done
                    return [self._outcome(future, self._futures.pop(future)) for future in done]
                except TimeoutError:
                    alone_s = 0.0 if self._client.nthreads() else alone_s + LOOK_S
            if alone_s >= WORKERS_S:
                raise StoppedError(
                    f"The cluster at {self._address} has had no workers for {WORKERS_S:.0f} s. What is done is kept: "
                    "give the same command again when it has some."
                )

    @contextmanager
    def _reached(self) -> Iterator[None]:
        try:
            yield
        except TimeoutError:  # an OSError
            raise
        except (OSError, CancelledError) as error:
            raise StoppedError(
                f"The scheduler at {self._address} has gone. What is done is kept: give the same command again when it "
                "is back, or without --scheduler."
            ) from error

    def _outcome(self, future: Any, task: Any) -> Outcome:
        error = future.exception()
        if error is None:
            outcome: Outcome = future.result()
        elif type(error).__name__ == "KilledWorker":
            said = "workers that had it were lost, one after another"
            outcome = Outcome(task, failure=Failure(Cause.LOST, said, is_given_up=True))
        else:
            outcome = Outcome(task, failure=failure_of(error))
        future.release()
        return outcome

    def close(self) -> None:
        """Take what is left of the run from the cluster."""
        with suppress(Exception):  # a scheduler that has gone has nothing left
            self._client.cancel(list(self._futures), force=True)
            self._client.unregister_worker_plugin(self._name)
        with suppress(Exception):
            self._client.close(timeout=CONNECT_S)

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _plugin(name: str, function: bytes) -> Any:
    """Brings a run's function to every worker of the cluster, those that join later too."""
    from distributed import WorkerPlugin

    class Plugin(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            begin(name, function)

        def teardown(self, worker: Any) -> None:
            end(name)

    return Plugin()
