"""Report progress, errors and interrupts on the terminal."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer

from ..interrupts import (
    INTERRUPT_EXIT_CODE,
    INTERRUPT_MESSAGE,
    interrupt_listener,
    message_printed,
)


@contextmanager
def progress_line() -> Iterator[Callable[[str], None]]:
    """Report progress on stderr: one changing line on a terminal, plain lines elsewhere."""
    from rich.console import Console

    # On stderr, so that redirected results contain no progress.
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: console.print(text, highlight=False, soft_wrap=True)
        return
    with console.status("starting") as status:
        yield lambda text: status.update(text)


@contextmanager
def errors_reported(debug: bool) -> Iterator[None]:
    """Print an error that a user can correct as one line, and report an interrupt."""
    try:
        with interrupt_listener():
            yield
    except KeyboardInterrupt:
        if not message_printed.is_set():
            message_printed.set()
            typer.echo(INTERRUPT_MESSAGE, err=True)
        sys.exit(INTERRUPT_EXIT_CODE)
    except (ValueError, OSError) as error:
        if debug:
            raise
        typer.echo(f"smartview: {error}", err=True)
        sys.exit(2)
