"""Put the subcommands together to the `smartview` command."""

from typing import Annotated

import typer

from .calibrate import calibrate
from .check import check
from .compare import compare
from .demo import demo
from .evaluate import evaluate
from .export import export
from .grasp import grasp
from .logs import configure_logs
from .model import model
from .new import new
from .plan import plan
from .schema import schema
from .simulate import simulate
from .stylus import stylus
from .viewpoint import viewpoint

app = typer.Typer(
    help="Calibrate cameras on robot arms.", no_args_is_help=True, pretty_exceptions_enable=False
)


def _version(requested: bool) -> bool:
    """Print the version and exit, if that was requested."""
    if requested:
        from .. import __version__

        typer.echo(f"smartview_jax {__version__}")
        raise typer.Exit
    return requested


@app.callback()
def main(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    verbose: Annotated[
        int,
        typer.Option(
            "--verbose",
            "-v",
            count=True,
            help="Also say what is done; -vv everything, also of others.",
        ),
    ] = 0,
) -> None:
    """Calibrate cameras on robot arms.

    What is compiled is kept in ~/.cache/smartview_jax for the next run; JAX_COMPILATION_CACHE_DIR
    names another place, JAX_ENABLE_COMPILATION_CACHE=0 turns that off.
    """
    # Before anything else is imported: some libraries look at their level once.
    # A program that calls the command keeps its own loggers as they were.
    context.call_on_close(configure_logs(verbose))


for _subcommand in (
    calibrate,
    check,
    compare,
    demo,
    evaluate,
    export,
    grasp,
    model,
    new,
    plan,
    schema,
    simulate,
    stylus,
    viewpoint,
):
    app.command()(_subcommand)
