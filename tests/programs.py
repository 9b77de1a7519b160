"""Count the programs that XLA is given to compile, or that are read instead."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax

from smartview_jax.runtime.program_store import READ_EVENT

NEW_PROGRAM = ("/jax/core/compile/backend_compile_duration", READ_EVENT)


@contextmanager
def programs_added() -> Iterator[list[float]]:
    """Gives a list of the seconds that each new program takes; those that exist are kept."""
    seconds: list[float] = []

    def note(event: str, duration: float, **_: str) -> None:
        if event in NEW_PROGRAM:
            seconds.append(duration)

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield seconds
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
