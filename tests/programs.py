"""Count the programs that XLA is given to compile."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax

COMPILED = "/jax/core/compile/backend_compile_duration"


@contextmanager
def programs_built(fresh: bool = True) -> Iterator[list[float]]:
    """Gives a list of the seconds that each takes.

    Every program is built again within, unless `fresh` is False, which spares the tests that
    follow: programs that are there already do not count then.
    """
    seconds: list[float] = []

    def note(event: str, duration: float, **_: str) -> None:
        if event == COMPILED:
            seconds.append(duration)

    if fresh:
        jax.clear_caches()
    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield seconds
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
