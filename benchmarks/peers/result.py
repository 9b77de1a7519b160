"""What every peer prints: one line of JSON."""

import json
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Found = TypeVar("Found")

PATIENCE = 30.0
"""Seconds after which a fit is not repeated once more."""


def timed(fit: Callable[[], Found], repeats: int, start: float) -> tuple[Found, list[float], float]:
    """What a fit found, seconds of each repeat, and of the first answer since the process began."""
    found = fit()
    cold = time.perf_counter() - start
    seconds: list[float] = []
    while len(seconds) < repeats and (not seconds or sum(seconds) < PATIENCE):
        began = time.perf_counter()
        found = fit()
        seconds.append(time.perf_counter() - began)
    return found, seconds, cold


def report(
    seconds: list[float], cost: float | None, iterations: float, cold: float, **more: float
) -> None:
    """Seconds of each repeat, final cost, iterations, and the first answer from process start.

    The cost is None of a peer whose lens is another: it has another optimum. Further figures are
    printed by their names.
    """
    print(
        json.dumps(
            {
                "seconds": seconds,
                "cost": cost,
                "iterations": iterations,
                "cold": cold,
                "peak_mb": _peak_mb(),
                **more,
            }
        )
    )


def _peak_mb() -> float:
    """Of this program alone; `getrusage` also counts what the process was before it."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024.0
