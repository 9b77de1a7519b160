"""Apply a function to many inputs in worker processes, and lose no result to a failure.

A function that raises an error loses its own result only. A worker process that is killed, for
instance because memory ran out, breaks the whole pool of `concurrent.futures`: every job that was
submitted ends with a `BrokenExecutor`, and nothing says which job was to blame. The jobs are then
repeated in a new pool, one at a time, so that a job that kills its worker is recognised: it is the
only one that runs.
"""

import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sized
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax

from ..runtime.compilation import optimise_all_programs
from .transport import from_bytes, to_bytes

JOBS_PER_WORKER = 2
"""Jobs that are submitted at the same time for each worker: one that runs, and the next one.

With only one, a worker would wait while its result is read and the next input is sent.
"""

MAX_LONELY_DEATHS = 2
"""Number of workers that a job may kill while no other job runs, before it counts as its fault.

One death may have another cause, such as a system that ran out of memory.
"""

MIN_OPTIMISED_JOBS = 500
"""Smallest number of inputs for which worker processes optimise the programs of small data sets.

Optimisation takes 7 s of a processor, once a machine, and saves 15 ms of each calibration of three
views.
"""

_SHARED_SETTINGS = (
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
)
"""JAX's settings of the compiled programs on disk, which workers take over."""


class Outcome(NamedTuple):
    """The result of a function for one input, or the error that it raised.

    Attributes:
        number: position of the input, from zero.
        result: what the function returned; None after an error.
        error: the error; None if there is a result.
    """

    number: int
    result: Any
    error: Exception | None


class _Job(NamedTuple):
    """An input and its number.

    Attributes:
        number: position of the input, from zero.
        is_suspect: whether a worker died while the job was running; it is then repeated alone.
        lonely_deaths: how often a worker died while no other job ran.
    """

    number: int
    item: Any
    is_suspect: bool = False
    lonely_deaths: int = 0


def outcomes(
    function: Callable[[Any], Any],
    inputs: Iterable[Any],
    executor: Executor | int | None = None,
    input_count: int | None = None,
) -> Iterator[Outcome]:
    """Apply a function to every input, and yield each result or error as soon as it is known.

    Only a few inputs and results are in memory at a time, so `inputs` may be endless.

    Args:
        function: function of one input. For processes, functions, inputs and results have to be
            picklable.
        executor: any executor of `concurrent.futures`, which stays open; a number of processes of
            this machine; or None for as many processes as there are processors. If a given executor
            breaks, the work goes on in processes of this machine.
        input_count: number of inputs, if it is known and `inputs` has no length. Processes of this
            machine optimise their programs for many inputs or an unknown number of them
            (`MIN_OPTIMISED_JOBS`).

    Raises:
        RuntimeError: worker processes cannot be started.
    """
    if input_count is None and isinstance(inputs, Sized):
        input_count = len(inputs)
    are_many = input_count is None or input_count >= MIN_OPTIMISED_JOBS
    upcoming = iter(enumerate(inputs))
    running: dict[Future[Any], _Job] = {}
    suspects: deque[_Job] = deque()
    with _Workers(executor, are_many) as workers, _cancelled_at_the_end(running):
        while True:
            while job := _next_job(upcoming, suspects, running.values(), workers.capacity):
                try:
                    running[workers.submit(function, job.item)] = job
                except BrokenExecutor:
                    # A worker died meanwhile; the jobs that were running say so themselves.
                    suspects.append(job._replace(is_suspect=True))
                    if running:
                        break
                    workers.renew()
            if not running:
                return
            alone = len(running) == 1
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            if any(isinstance(_error_of(future), BrokenExecutor) for future in finished):
                # The whole pool ended, though some of its jobs may have finished before.
                finished, _ = wait(running)
            broken = []
            while finished:
                job = running.pop(future := finished.pop())
                if isinstance(_error_of(future), BrokenExecutor):
                    deaths = job.lonely_deaths + alone
                    broken.append(job._replace(is_suspect=True, lonely_deaths=deaths))
                else:
                    workers.has_finished_a_job = True
                    outcome = _outcome_of(job.number, future)
                    # It would keep the result in memory longer than the caller does.
                    del future
                    yield outcome
                    del outcome
            if broken:
                workers.renew()
            for job in sorted(broken, key=lambda job: job.number):
                if job.lonely_deaths < MAX_LONELY_DEATHS:
                    suspects.append(job)
                else:
                    yield Outcome(job.number, None, _killed(job))


@contextmanager
def _cancelled_at_the_end(running: Collection[Future[Any]]) -> Iterator[None]:
    """Cancel the jobs that have not begun when the caller wants no more results."""
    try:
        yield
    finally:
        for future in running:
            future.cancel()


def _next_job(
    upcoming: Iterator[tuple[int, Any]],
    suspects: deque[_Job],
    running: Collection[_Job],
    capacity: int,
) -> _Job | None:
    """Return the next job to submit; None if there is none, or no room for it."""
    if suspects:
        return None if running else suspects.popleft()
    if len(running) >= capacity or any(job.is_suspect for job in running):
        return None
    return next((_Job(number, item) for number, item in upcoming), None)


def _killed(job: _Job) -> RuntimeError:
    """Return the error of a job whose worker was killed again and again."""
    return RuntimeError(
        f"the worker process was killed {job.lonely_deaths} times while it ran this job alone: not "
        "enough memory, or a crash in a library"
    )


def _error_of(future: Future[Any]) -> Exception | None:
    """Return the error with which a job ended; None for a result."""
    try:
        error = future.exception()
    except Exception as cancelled:
        # Somebody else shut the executor down.
        return cancelled
    if error is not None and not isinstance(error, Exception):
        raise error
    return error


def _outcome_of(number: int, future: Future[Any]) -> Outcome:
    """Return the result of a job that has ended, or its error, such as an unreadable result."""
    error = _error_of(future)
    if error is not None:
        return Outcome(number, None, error)
    try:
        return Outcome(number, _received(future.result()), None)
    except Exception as unreadable:
        reason = f"{type(unreadable).__name__}: {unreadable}"
        return Outcome(number, None, RuntimeError(f"the result cannot be read here: {reason}"))


class _Workers:
    """The executor that runs the jobs, replaced after a worker was killed.

    Once a job has finished, its programs are compiled.
    """

    def __init__(self, executor: Executor | int | None, optimise: bool = False):
        self._given = executor if isinstance(executor, Executor) else None
        self._process_count = executor if isinstance(executor, int) else _processor_count()
        self._optimise = optimise
        self._own: ProcessPoolExecutor | None = None
        self.has_finished_a_job = False

    def __enter__(self) -> "_Workers":
        if self._given is None:
            self._own = _process_pool(self._process_count, self._optimise)
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    @property
    def capacity(self) -> int:
        """The number of jobs that may be submitted at the same time."""
        if self._given is not None:
            return JOBS_PER_WORKER * max(_worker_count(self._given), self._process_count)
        # The first job runs alone: it compiles the programs that the other workers then read.
        return JOBS_PER_WORKER * self._process_count if self.has_finished_a_job else 1

    def submit(self, function: Callable[[Any], Any], item: Any) -> Future[Any]:
        """Submit a job."""
        executor = self._given or self._own
        assert executor is not None
        if isinstance(executor, ThreadPoolExecutor):
            # Threads share memory.
            return executor.submit(function, item)
        try:
            job = to_bytes((function, item))
        except Exception as error:
            future: Future[Any] = Future()
            future.set_exception(error)
            return future
        if executor is self._given:
            return executor.submit(_call, job)
        with _threads_of_new_processes(self._process_count):
            return executor.submit(_call, job)

    def renew(self) -> None:
        """Go on in new processes."""
        self._close()
        self._given, self._own = None, _process_pool(self._process_count, self._optimise)

    def _close(self) -> None:
        """End the own processes, without the jobs that have not begun."""
        if self._own is not None:
            self._own.shutdown(wait=False, cancel_futures=True)


def _worker_count(executor: Executor) -> int:
    """Return the number of an executor's workers, as far as it is known."""
    # Pools of the standard library say it under this name only, and others do not at all.
    count = getattr(executor, "_max_workers", 0)
    return count if isinstance(count, int) else 0


def _processor_count() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _process_pool(count: int, optimise: bool) -> ProcessPoolExecutor:
    """Return a pool of new processes that run jobs, and optimise small programs on request."""
    settings = {name: jax.config.values[name] for name in _SHARED_SETTINGS}
    # A forked process would have locks of JAX's threads, but not the threads that release them.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, context, _start_worker, (settings, optimise))
    try:
        with _threads_of_new_processes(count):
            first = pool.submit(os.getpid)
        first.result()
    except BrokenExecutor as error:
        raise RuntimeError(
            "worker processes cannot be started. They import the script that starts them, so a "
            "script needs `if __name__ == '__main__':` before the call; or pass "
            "concurrent.futures.ThreadPoolExecutor(1) as executor"
        ) from error
    return pool


@contextmanager
def _threads_of_new_processes(count: int) -> Iterator[None]:
    """Give each of so many processes its share of the threads that run programs.

    XLA would start one for each processor in each process, and they wait for work without pause.
    It reads their number from the environment when it starts, which is while a process imports its
    modules, so that only its parent can set it. A user's own number is kept.
    """
    if "NPROC" in os.environ:
        yield
        return
    os.environ["NPROC"] = str(max(_processor_count() // count, 1))
    try:
        yield
    finally:
        del os.environ["NPROC"]


def _start_worker(settings: dict[str, Any], optimise: bool) -> None:
    """Prepare a worker process."""
    if optimise:
        optimise_all_programs()
    for name, value in settings.items():
        jax.config.update(name, value)
    # An interrupt ends workers at once and without a traceback; the main process reports it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the main process ends, which a killed one cannot ask for."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class _Sent(NamedTuple):
    """A result as bytes, from another process."""

    data: bytes


def _call(job: bytes) -> _Sent:
    """Call a function in a worker; replace an error that could not be sent to another process."""
    try:
        function, item = from_bytes(job)
        return _Sent(to_bytes(function(item)))
    except Exception as error:
        try:
            # An error whose constructor takes other arguments than it keeps fails at reading, in
            # the main process, and would break the pool.
            pickle.loads(pickle.dumps(error))
        except Exception:
            raise RuntimeError(f"{type(error).__name__}: {error}") from None
        raise


def _received(result: Any) -> Any:
    """Return the result of a job; threads return it as it is."""
    return from_bytes(result.data) if isinstance(result, _Sent) else result
