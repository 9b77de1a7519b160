"""Put the subcommands together to the `smartview` command."""

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from .calibrate import calibrate
from .check import check
from .compare import compare
from .demo import demo
from .evaluate import evaluate
from .export import export
from .garbage import rare_collections
from .grasp import grasp
from .localize import localize
from .logs import configure_logs
from .model import model
from .new import new
from .plan import plan
from .schema import schema
from .simulate import simulate
from .stylus import stylus
from .viewpoint import viewpoint


class _LoggingGroup(TyperGroup):
    """The subcommands, each of which logs as `--verbose` says, and collects garbage rarely."""

    def invoke(self, ctx: Any) -> Any:
        """Run a subcommand, and leave the loggers of a program that calls it as they were."""
        # Before anything else is imported: some libraries look at their level once.
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
    pretty_exceptions_enable=False,
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


for _subcommand in (
    calibrate,
    check,
    compare,
    demo,
    evaluate,
    export,
    grasp,
    localize,
    model,
    new,
    plan,
    schema,
    simulate,
    stylus,
    viewpoint,
):
    app.command()(_subcommand)
