"""The bar on a terminal moves with what the texts count."""

import io
import subprocess
import sys

import pytest
from rich.console import Console
from rich.progress import Progress

from smartview_jax.cli.terminal import BarUpdate, StageLines, print_error, print_lines, print_steps


@pytest.fixture
def bar():
    return Progress(console=Console(file=io.StringIO(), force_terminal=True), transient=True)


def test_the_bar_shows_what_is_done_of_what_is_counted(bar):
    show = BarUpdate(bar)
    show("Step 1: each of 15 views by itself")
    assert bar.tasks[0].total is None
    show("looking for the target: view a7 (3 of 15)")
    assert (bar.tasks[0].completed, bar.tasks[0].total) == (2, 15)
    assert bar.tasks[0].description.endswith("view a7 (3 of 15)")
    first = bar.tasks[0].id
    show("looking for the target: view b1 (4 of 15)")
    assert bar.tasks[0].completed == 3
    assert bar.tasks[0].id == first


def test_a_stage_without_a_colon_keeps_its_bar(bar):
    show = BarUpdate(bar)
    show("fold 1 of 5")
    first = bar.tasks[0].id
    show("fold 2 of 5")
    assert bar.tasks[0].id == first
    assert (bar.tasks[0].completed, bar.tasks[0].total) == (1, 5)


def test_every_stage_has_a_bar_of_its_own(bar):
    show = BarUpdate(bar)
    show("held-out: fold 5 of 5")
    first = bar.tasks[0].id
    show("drawing the report")
    assert len(bar.tasks) == 1
    assert bar.tasks[0].id != first
    assert bar.tasks[0].total is None


def test_without_a_terminal_every_stage_is_one_line():
    printed = io.StringIO()
    show = StageLines(Console(file=printed))
    for k in range(3):
        show(f"looking for the target: view v{k}a ({k + 1} of 3)")
    for k in range(4):
        show(f"pass {k + 1}: sigma {0.7 / (1 + k):.3g} px, changed by {10.0**-k:.2g} sigma")
    show("Step 3: hand-eye and world transforms")
    for k in range(2):
        show(f"held-out: fold {k + 1} of 2")
    for name in ("left", "right"):
        show(f"{name} done: {1 + (name == 'right')} of 2")
    assert printed.getvalue().splitlines() == [
        "looking for the target: view v0a (1 of 3)",
        "pass 1: sigma 0.7 px, changed by 1 sigma",
        "Step 3: hand-eye and world transforms",
        "held-out: fold 1 of 2",
        "left done: 1 of 2",
        "right done: 2 of 2",
    ]


def test_prose_is_wrapped_also_in_pipes_and_commands_are_not(capsys):
    prose = "doubt: " + "the camera moves as far as the robot says, " * 4
    path = "/a" * 60
    print_lines(prose, f"  view 3 is left out: {path}: " + "a damaged picture, " * 5)
    lines = capsys.readouterr().out.splitlines()
    assert " ".join(line.strip() for line in lines).startswith(prose.strip())
    assert [line[:2] for line in lines if line.startswith(("doubt", "  view"))] == ["do", "  "]
    assert all(len(line) <= 80 for line in lines if path not in line)
    # Continued lines are indented further than the line that they continue.
    view = next(k for k, line in enumerate(lines) if line.startswith("  view"))
    assert all(line.startswith("  ") for line in lines[1:view])
    assert all(line.startswith("    ") for line in lines[view + 1 :])
    print_steps([f"smartview check {path}", "write " * 20])
    command, *steps = capsys.readouterr().out.splitlines()
    assert command == f"  1. smartview check {path}"
    assert len(steps) == 2


def test_an_error_is_one_line_in_pipes_and_wrapped_between_words_on_a_terminal(capsys, monkeypatch):
    error = ValueError(
        "dataset.yaml: target: no entry is called 'spaceing'; " + "it has rows, " * 5
    )
    monkeypatch.setenv("COLUMNS", "40")
    print_error(error)
    assert capsys.readouterr().err == f"smartview: {error}\n"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    print_error(error)
    first, *rest = capsys.readouterr().err.splitlines()
    assert all(len(line) <= 40 and line.startswith("  ") for line in (*rest, f"  {first[2:]}"))
    assert " ".join((first, *map(str.strip, rest))) == f"smartview: {error}".strip()


PRINTS_FOR_EVER = """
import typer
from smartview_jax.cli.terminal import errors_reported
with errors_reported(False):
    while True:
        {}
"""


@pytest.mark.parametrize(
    ("statement", "code", "message"),
    [
        ("typer.echo('a line')", 1, b""),
        ("raise BrokenPipeError('the robot')", 2, b"smartview: the robot"),
    ],
    ids=["of the reader", "of another connection"],
)
def test_a_closed_pipe(statement, code, message):
    """`smartview ... | head -1` ends without a word; a robot that hangs up is an error."""
    words = [sys.executable, "-c", PRINTS_FOR_EVER.format(statement)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read().strip() == message
    assert process.returncode == code
