"""Executors run jobs: in this process, in local processes, or on a Dask cluster; one interface."""

from __future__ import annotations

import concurrent.futures as cf
import contextlib
import dataclasses
import importlib
import importlib.metadata
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from semstab.core.prefetch import default_threads
from semstab.core.process import configure_process, follow_parent
from semstab.engine.frame_loop import run_job
from semstab.engine.observer import Observers
from semstab.engine.work import Job, Work
from semstab.errors import ConfigError, MissingDependencyError

CONNECT_SECONDS = 10
ENDING_SECONDS = 5
AWAY = OSError, RuntimeError, AttributeError
"""The errors of a client of Dask whose scheduler does not answer, while it gives it up, and once it has none."""

LOST = "the scheduler does not answer any more; start it again, and the same command continues from the finished units"

Future = cf.Future[Job]
NextJob = Callable[[], Job | None]
"""A function that returns the next job, or None without a job until a yielded work calls for more."""


class Executor:
    """A runner of jobs, `width` at once, in other processes if `elsewhere`; `name` is for the manifest."""

    name: str
    width = 1
    elsewhere = False

    def run(self, next_job: NextJob, observers: Observers) -> Generator[Work, None, None]:
        """Yield works as they finish, in any order. Closing the iterator stops the rest.

        A job is taken when there is somebody to do it. `observers` see the work that is done in this very process.
        """
        raise NotImplementedError

    def close(self) -> None:
        """End it: nothing more is to be run."""


class InProcess(Executor):
    """One job after the other, in this process."""

    name = "in this process"

    def run(self, next_job: NextJob, observers: Observers) -> Generator[Work, None, None]:
        """Run them in order."""
        while (job := next_job()) is not None:
            yield from run_job(job, observers)


class LocalProcesses(Executor):
    """An executor of that many processes on this machine, which share its cores and its free memory."""

    elsewhere = True

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise ConfigError(f"{jobs} jobs: use 1 or more")
        self.width = jobs
        self.name = f"{jobs} local processes"

    def run(self, next_job: NextJob, observers: Observers) -> Generator[Work, None, None]:
        """Yield works as jobs finish.

        If a process dies, its job is not known: those that were running are run again, one by one. The job
        whose process dies then fails, and the others finish.
        """
        begun = list[Job]()
        while True:
            with contextlib.suppress(BrokenProcessPool):
                yield from self._run(begun, next_job, self.width)
                return
            while begun:
                try:
                    yield from self._run(begun, lambda: None, 1)
                except BrokenProcessPool:
                    text = "its process was killed, perhaps because memory ran out; try fewer jobs, or larger voxels"
                    yield from (work.failed(text) for work in begun.pop(0))

    def _run(self, begun: list[Job], next_job: NextJob, width: int) -> Generator[Work, None, None]:
        """Run the jobs that were begun before, then the next ones; begun stay those that are not finished."""
        waiting = [*begun]

        def take() -> Job | None:
            if waiting:
                return waiting.pop(0)
            if (job := next_job()) is None:
                return None
            threads = max(1, (job[0].start.threads or default_threads()) // self.width)
            begun.append(_with_start(job, threads=threads, width=self.width))
            return begun[-1]

        if (first := take()) is None:
            return
        waiting.insert(0, first)
        context = multiprocessing.get_context("spawn")
        listening, alive = context.Pipe(duplex=False)
        share = max(1, cores() // self.width)
        pool = cf.ProcessPoolExecutor(width, context, initializer=_start_worker, initargs=(listening, share))
        before, done = {*multiprocessing.active_children()}, False

        def submit(job: Job) -> Future:
            with _left_alone():
                return pool.submit(_run_all, job)

        try:
            _check_start(pool)
            for future, job in _ended(take, submit, lambda: width):
                works = future.result()
                begun[:] = [other for other in begun if other is not job]
                yield from works
            pool.shutdown()
            done = True
        finally:
            alive.close()  # ends processes that are still at work, should this one be killed meanwhile
            if not done:  # after an interruption, or where one of them died
                _end_all({*multiprocessing.active_children()} - before)
            pool.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _left_alone() -> Iterator[None]:
    """Let processes that the block starts never hear Ctrl-C, which their parent decides on; it is heard afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_all(processes: Iterable[BaseProcess]) -> None:
    """End processes at once, those that still import among them: what they write is whole, or is not there."""
    for process in processes:
        process.kill()
    for process in processes:
        process.join(ENDING_SECONDS)


def _ended(
    next_job: NextJob, submit: Callable[[Job], Future], width: Callable[[], int]
) -> Generator[tuple[Future, Job], None, None]:
    """Yield each job that ended, and its future; as many are submitted as can run at once.

    The next ones are submitted before one is yielded: nobody waits for whoever takes its works.
    """
    jobs = dict[Future, Job]()

    def fill() -> None:
        while len(jobs) < width() and (job := next_job()) is not None:
            jobs[submit(job)] = job

    fill()
    try:
        while jobs:
            for future in cf.wait(jobs, return_when=cf.FIRST_COMPLETED).done:
                job = jobs.pop(future)
                fill()
                yield future, job
                fill()
    finally:
        for future in jobs:
            future.cancel()


def _with_start(job: Job, **changes: Any) -> Job:
    start = dataclasses.replace(job[0].start, **changes)
    return tuple(dataclasses.replace(work, start=start) for work in job)


def _run_all(job: Job) -> Job:
    return tuple(run_job(job))


def _check_start(pool: cf.ProcessPoolExecutor) -> None:
    """Raise ConfigError if not even an empty job runs: a script that starts processes must be importable."""
    with _left_alone():
        first = pool.submit(os.getpid)
    try:
        first.result()
    except BrokenProcessPool as error:
        raise ConfigError(
            "worker processes do not start; in your script, call it under if __name__ == '__main__'"
        ) from error


def _start_worker(listening: Connection, threads: int) -> None:
    """Set a worker process up: with its share of the cores, and so that it ends with its parent."""
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))  # read when Open3D is loaded
    configure_process()
    _use_threads(threads)
    follow_parent(listening)


def _use_threads(count: int) -> None:
    """Set the number of threads for compiled loops and for reading tables."""
    import numba
    import pyarrow as pa

    numba.set_num_threads(min(count, numba.get_num_threads()))
    pa.set_cpu_count(count)


class DaskCluster(Executor):
    """The workers of a Dask scheduler, for example tcp://127.0.0.1:8786; they must have semstab and see the data.

    Raises:
        MissingDependencyError: Without dask.
        ConfigError: If no scheduler answers.
    """

    elsewhere = True

    def __init__(self, scheduler: str) -> None:
        try:
            self._client = _distributed().Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{scheduler}: no Dask scheduler answers ({error}); start one with 'dask scheduler'"
            ) from error
        self.width = self._threads() or 1
        self.name = f"Dask, {self.width} threads"

    def run(self, next_job: NextJob, observers: Observers) -> Generator[Work, None, None]:
        """Yield works as jobs finish. The scheduler gives the job of a worker that died to another one.

        There are never more at the scheduler than its workers have threads, so that whoever is free has the next one.

        Raises:
            ConfigError: If the scheduler went away and jobs are left.
        """
        if (first := next_job()) is None:
            return
        self._require_same_version()
        waiting, pool = [first], self._client.get_executor(pure=False)

        def take() -> Job | None:
            return waiting.pop() if waiting else next_job()

        for future, job in _ended(take, lambda job: pool.submit(_run_settled, job), self._threads):
            if future.cancelled():
                yield from (work.failed(LOST) for work in job)
                continue
            try:
                works = future.result()
            except Exception as error:  # noqa: BLE001 - any error of a job on the cluster
                works = tuple(work.failed(error) for work in job)
            yield from works
        if take() is not None:
            raise ConfigError(LOST)

    def _threads(self) -> int:
        """Return threads of the workers that there are now; 0 where the scheduler does not answer."""
        try:
            self.width = max(1, sum(self._client.nthreads().values()))
        except AWAY:
            return 0
        return self.width

    def close(self) -> None:
        """Leave the scheduler."""
        self._client.close()

    def _require_same_version(self) -> None:
        """Raise ConfigError where a worker's semstab is missing, or another one."""
        own_version = importlib.metadata.version("semstab")
        try:
            versions = self._client.run(importlib.metadata.version, "semstab")
        except importlib.metadata.PackageNotFoundError as error:
            raise ConfigError("a worker of the scheduler has no semstab; install semstab there") from error
        except AWAY as error:
            raise ConfigError(LOST) from error
        if not versions:
            raise ConfigError("the scheduler has no worker; start some with 'dask worker'")
        for worker, version in versions.items():
            if version != own_version:
                raise ConfigError(
                    f"worker {worker} has semstab {version}, this process has {own_version}; install the same version"
                    " on both"
                )


def _run_settled(job: Job) -> Job:
    """Run a job in a worker of the cluster, with as many threads as are its own.

    A worker runs a job in each of its threads at once: frames are decoded in turn unless `threads` is set.
    """
    configure_process()
    with contextlib.suppress(ValueError):  # called outside of a worker
        _use_threads(_distributed().get_worker().state.nthreads)
    return _run_all(_with_start(job, threads=job[0].start.threads or 0))


def _distributed() -> Any:
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise MissingDependencyError("a Dask cluster needs more packages: pip install 'semstab[cluster]'") from error


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
