"""Put the subcommands together to the `smartview` command."""

import gc
import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import smartview_jax as sv

from .calibrate import calibrate
from .capture import capture
from .check import check
from .compare import compare
from .demo import demo
from .evaluate import evaluate
from .export import export
from .grasp import grasp
from .import_recording import import_
from .localize import localize
from .logs import configure_logs
from .model import model
from .new import new
from .plan import plan
from .schema import schema
from .simulate import simulate
from .stylus import stylus
from .viewpoint import viewpoint

OBJECTS_BETWEEN_COLLECTIONS = 100_000
"""Number of new objects after which the youngest generation is collected; Python's own is 700."""


class _LoggingGroup(TyperGroup):
    """A group of subcommands that sets the log level and collects garbage rarely."""

    def invoke(self, ctx: Any) -> Any:
        """Run a subcommand, then restore the loggers of the calling program."""
        # Before anything else is imported: some libraries read their log level only once.
        restore = configure_logs(ctx.params["verbose"])
        with rare_collections():
            try:
                return super().invoke(ctx)
            finally:
                restore()


app = typer.Typer(
    cls=_LoggingGroup,
    help="Calibrate cameras on robot arms.",
    no_args_is_help=True,
    # Plain help: rich cuts words that are longer than its columns, such as the syntax of --prior.
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _version(requested: bool) -> bool:
    """Print the version and exit, if that was requested."""
    if requested:
        typer.echo(f"smartview_jax {sv.__version__}")
        raise typer.Exit
    return requested


@contextmanager
def rare_collections() -> Iterator[None]:
    """Collect garbage rarely, then restore the settings of the calling program.

    Tracing and compiling create about a hundred thousand objects that live as long as the process.
    Scanning them again and again takes a tenth of a calibration's time and frees almost nothing.
    """
    young, *older = gc.get_threshold()
    # A program that turned collection off (zero), or made it rarer still, keeps its setting.
    gc.set_threshold(max(young, OBJECTS_BETWEEN_COLLECTIONS) if young else 0, *older)
    try:
        yield
    finally:
        gc.set_threshold(young, *older)


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    verbose: Annotated[
        int,
        typer.Option(
            "--verbose",
            "-v",
            count=True,
            help="Log progress, and print the hand-eye transform as matrix, quaternion, angles of "
            "ROS and in the robot's format; -vv also logs what JAX, OpenCV and other libraries "
            "report.",
        ),
    ] = 0,
) -> None:
    """Calibrate cameras on robot arms.

    Compiled programs are kept in ~/.cache/smartview_jax for the next run;
    JAX_COMPILATION_CACHE_DIR names another folder, JAX_ENABLE_COMPILATION_CACHE=0 turns this off.
    """


for _subcommand in (
    calibrate,
    capture,
    check,
    compare,
    demo,
    evaluate,
    export,
    grasp,
    import_,
    localize,
    model,
    new,
    plan,
    schema,
    simulate,
    stylus,
    viewpoint,
):
    # The whole first sentence, because a summary of click's own length is cut.
    _summary = (inspect.getdoc(_subcommand) or "").partition("\n\n")[0]
    # The name of a function may not be a word of Python, such as import.
    app.command(_subcommand.__name__.rstrip("_"), short_help=_summary)(_subcommand)
