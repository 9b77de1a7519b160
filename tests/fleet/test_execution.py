"""No result is lost to a failure of another job or of a worker, and few are in memory."""

import multiprocessing
import os
import signal
import weakref
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import jax
import numpy as np
import pytest

from smartview_jax.fleet import execution, outcomes
from smartview_jax.fleet.transport import to_bytes
from smartview_jax.runtime import compilation


class InPlace(ThreadPoolExecutor):
    """Runs a job when it is submitted; `deaths` are jobs that break the pool, as often as given."""

    def __init__(self, deaths=None):
        super().__init__(1)
        self.deaths, self.is_broken = dict(deaths or {}), False

    def submit(self, function, *arguments):
        future = Future()
        item = arguments[-1]
        if self.is_broken or self.deaths.get(item, 0):
            if not self.is_broken:
                self.deaths[item] -= 1
            self.is_broken = True
            future.set_exception(BrokenExecutor("a worker died"))
            return future
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future


def tenth(number):
    if number == 3:
        raise ValueError("three is odd")
    return number / 10


def by_index(found):
    return {one.number: str(one.error) if one.error else one.result for one in found}


@pytest.mark.parametrize("make", [InPlace, lambda: ThreadPoolExecutor(2)])
def test_an_error_loses_its_own_result_only(make):
    with make() as executor:
        found = by_index(outcomes(tenth, range(5), executor))
    assert found == {0: 0.0, 1: 0.1, 2: 0.2, 3: "three is odd", 4: 0.4}
    assert list(outcomes(tenth, [], InPlace())) == []


class Unreadable:
    """A result that can be sent to another process, but not read there."""

    def __reduce__(self):
        return float, ("no number",)


def test_a_result_that_cannot_be_read_loses_itself_only():
    def sent(number):
        return execution._Sent(to_bytes(Unreadable() if number == 1 else number))

    found = by_index(outcomes(sent, range(3), InPlace()))
    assert (found[0], found[2]) == (0, 2)
    assert found[1].startswith("the result cannot be read here: ValueError: could not convert")


@pytest.fixture
def pools(monkeypatch):
    """Replacements of broken pools, which run in this process, share what kills them and count."""
    made = []

    def replace(deaths):
        def renewed(count, _):
            made.append(count)
            pool = InPlace()
            pool.deaths = deaths
            return pool

        monkeypatch.setattr(execution, "_process_pool", renewed)
        return made

    return replace


@pytest.mark.parametrize("killer", [0, 1, 6])
def test_a_death_costs_nothing_but_time(pools, killer):
    first = InPlace({killer: 1})
    made = pools(first.deaths)
    found = by_index(outcomes(lambda number: number, range(7), first))
    assert found == {number: number for number in range(7)}
    assert len(made) == 1


def test_a_job_that_kills_its_worker_again_and_again_is_an_error(pools):
    first = InPlace({1: 99, 4: 99})
    pools(first.deaths)
    found = by_index(outcomes(lambda number: number, range(7), first))
    for number in range(7):
        if number in (1, 4):
            assert "killed 2 times while it ran this job alone" in found[number]
        else:
            assert found[number] == number


class Input:
    """An input whose end is seen."""


def test_few_are_in_memory():
    alive, most = weakref.WeakSet(), 0

    def inputs():
        for _ in range(50):
            item = Input()
            alive.add(item)
            yield item

    with ThreadPoolExecutor(1) as executor:
        capacity = execution._Workers(executor).capacity
        for outcome in outcomes(lambda _: Input(), inputs(), executor):
            alive.add(outcome.result)
            del outcome
            most = max(most, len(alive))
    assert most <= 2 * capacity + 2


def test_a_result_that_was_taken_leaves_the_memory():
    """Also if several were ready together."""
    taken, most = weakref.WeakSet(), 0
    for outcome in outcomes(lambda _: Input(), range(20), InPlace()):
        taken.add(outcome.result)
        del outcome
        most = max(most, len(taken))
    assert most == 1


class ParticularError(Exception):
    """An error that cannot be read from its pickle, because its constructor takes two arguments."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def kill_once(number, folder):
    """Kill the worker at number 1, the first time; in any case do what the number says."""
    mark = folder / "killed"
    if number == 1 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 2:
        raise ParticularError("one", "two")
    return number, multiprocessing.parent_process() is not None


class KillOnce:
    """The function above with its folder, for processes."""

    def __init__(self, folder):
        self.folder = folder

    def __call__(self, number):
        return kill_once(number, self.folder)


def test_processes_are_replaced_and_errors_arrive(tmp_path):
    found = {one.number: one for one in outcomes(KillOnce(tmp_path), range(5), 2)}
    assert (tmp_path / "killed").exists()
    for number in (0, 1, 3, 4):
        assert found[number].result == (number, True)
    assert str(found[2].error) == "ParticularError: one and two"


def optimises(_):
    return compilation._min_elements == 0


@pytest.mark.parametrize(
    ("inputs", "count", "many"),
    [
        (range(2), None, False),
        (range(2), execution.MIN_OPTIMISED_JOBS, True),
        (iter([0]), None, True),
    ],
)
def test_processes_optimise_their_programs_for_many_jobs(inputs, count, many):
    assert {one.result for one in outcomes(optimises, inputs, 1, count)} == {many}


def threads_of_programs(_):
    jax.device_put(np.ones(1))
    names = []
    for task in Path("/proc/self/task").iterdir():
        # A thread may end while the list is read.
        with suppress(FileNotFoundError, ProcessLookupError):
            names.append((task / "comm").read_text())
    return sum("XLAEigen" in name for name in names)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="Linux lists threads there")
def test_as_many_processes_as_processors_run_programs_on_one_thread_each(monkeypatch):
    # The tests have several devices, each with threads of its own.
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.delenv("NPROC", raising=False)
    count = len(os.sched_getaffinity(0))
    (outcome,) = outcomes(threads_of_programs, [0], count)
    assert (outcome.result, outcome.error) == (1, None)


def test_a_script_without_a_guard_is_told(monkeypatch):
    class Broken:
        def __init__(self, *_):
            pass

        def submit(self, *_):
            raise BrokenExecutor("a worker died")

    monkeypatch.setattr(execution, "ProcessPoolExecutor", Broken)
    with pytest.raises(RuntimeError, match="if __name__ == '__main__':"):
        next(outcomes(tenth, [1], 1))
