"""Print lines and tables, and report progress, errors and interrupts on the terminal."""

import logging
import os
import re
import select
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, TextIO

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from ..extras import MissingExtraError
from ..runtime.interrupts import INTERRUPT_EXIT_CODE, interrupt_listener, print_message_once

_log = logging.getLogger(__name__)


def verbose() -> bool:
    """Return whether the command was called with -v."""
    return logging.getLogger(__package__).isEnabledFor(logging.INFO)


def print_lines(*texts: str) -> None:
    """Print texts as they are, one after the other, wrapped at the terminal's width.

    In files and pipes the width is 80. Continued lines are indented, so that each text is seen to
    begin; a word that is longer than a line, such as a path, stays whole.
    """
    console = Console()
    for line in "\n".join(texts).splitlines() if texts else ():
        console.print(_wrapped(line, console), highlight=False, markup=False, soft_wrap=True)


def print_error(error: BaseException) -> None:
    """Print an error on stderr: wrapped on a terminal, as one line in files and pipes."""
    console, text = Console(stderr=True), f"smartview: {error}"
    if sys.stderr.isatty():
        text = "\n".join(_wrapped(line, console) for line in text.splitlines())
    typer.echo(text, err=True)


def _wrapped(line: str, console: Console) -> str:
    """Return a line wrapped at the width of a console, with continued lines indented."""
    return textwrap.fill(
        line,
        console.width,
        subsequent_indent=" " * (len(line) - len(line.lstrip()) + 2),
        break_long_words=False,
        break_on_hyphens=False,
    )


def print_steps(steps: Iterable[str]) -> None:
    """Print numbered steps; commands are not wrapped, so that they can be copied."""
    for number, step in enumerate(steps, start=1):
        is_command = step.startswith("smartview ")
        (typer.echo if is_command else print_lines)(f"  {number}. {step}")


def print_table(
    headings: Iterable[str],
    rows: Iterable[Iterable[str]],
    justify: Literal["left", "right"] = "left",
    **style: Any,
) -> None:
    """Print a table in a style of rich's `Table`; texts of the first column stand left."""
    table = Table(**style)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify=justify if number else "left")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


@contextmanager
def progress_line() -> Iterator[Callable[[str], None]]:
    """Report progress on stderr: a bar with the time left on a terminal, else a line a stage.

    A text that counts, such as "fold 2 of 5", moves the bar; any other starts a bar without an end.
    """
    # On stderr, so that redirected results contain no progress.
    console = Console(stderr=True)
    # A moving bar would be torn apart by the lines of --verbose.
    if verbose():
        yield lambda text: _log.info("%s", text)
        return
    if not console.is_terminal:
        yield StageLines(console)
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        yield BarUpdate(bar)


class StageLines:
    """A function that prints the first line of every stage, for files and logs."""

    def __init__(self, console: Console):
        self._console = console
        self._stage = ""

    def __call__(self, text: str) -> None:
        stage = stage_of(text)
        if stage != self._stage:
            self._stage = stage
            self._console.print(text, highlight=False, soft_wrap=True, markup=False)


def stage_of(text: str) -> str:
    """Return what the lines of one stage have in common.

    Lines that count, as "fold 2 of 5", have the words before their colon; others, such as the
    passes of a filter, differ in their numbers only.
    """
    counted = _COUNTED.search(text)
    if counted is not None and ":" in text:
        return f"{text.partition(':')[0]} of {counted[2]}"
    return _NUMBERS.sub("#", text)


class BarUpdate:
    """A function that shows a line of text next to a progress bar."""

    def __init__(self, bar: Progress):
        self._bar = bar
        self._stage, self._task = "", bar.add_task("starting", total=None)

    def __call__(self, text: str) -> None:
        counted, stage = _COUNTED.search(text), stage_of(text)
        if stage != self._stage:
            # The time left is estimated from the speed, which differs between stages.
            self._bar.remove_task(self._task)
            self._stage, self._task = stage, self._bar.add_task(text, total=None)
        number, total = (None, None) if counted is None else map(int, counted.groups())
        self._bar.update(
            self._task,
            description=text,
            total=total,
            completed=0 if number is None else number - 1,
        )


_COUNTED = re.compile(r"\b(\d+) of (\d+)\)?$")
"""The end of a text that counts, such as "fold 2 of 5"."""

_NUMBERS = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""The numbers in a text."""


@contextmanager
def errors_reported(debug: bool) -> Iterator[None]:
    """Print an error that a user can correct, and report an interrupt."""
    try:
        with interrupt_listener():
            yield
    except KeyboardInterrupt:
        print_message_once(lambda text: typer.echo(text, err=True))
        sys.exit(INTERRUPT_EXIT_CODE)
    except (ValueError, OSError, MissingExtraError) as error:
        if isinstance(error, BrokenPipeError) and _is_closed(sys.stdout):
            sys.exit(CLOSED_PIPE_EXIT_CODE)
        if debug:
            raise
        print_error(error)
        sys.exit(2)


CLOSED_PIPE_EXIT_CODE = 1
"""Exit code of a command whose output nobody reads any more, such as before `| head`."""


def _is_closed(stream: TextIO) -> bool:
    """Return whether nobody reads the stream any more; if so, discard what is left to print."""
    poll = select.poll()
    poll.register(stream.fileno(), 0)
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    # Otherwise Python tries to print it once more when it ends, and reports an error.
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return True
