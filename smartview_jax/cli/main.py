"""Put the subcommands together to the `smartview` command."""

import gc
import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from keyword import iskeyword
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import smartview_jax as sv

from .logs import configure_logs

OBJECTS_BETWEEN_COLLECTIONS = 100_000
"""Number of new objects after which the youngest generation is collected; Python's own is 700."""


SUBCOMMANDS = {
    "calibrate": "calibrate",
    "capture": "capture",
    "check": "check",
    "compare": "compare",
    "demo": "demo",
    "evaluate": "evaluate",
    "export": "export",
    "grasp": "grasp",
    # The word import cannot be the name of a file or of a function.
    "import": "import_recording",
    "localize": "localize",
    "model": "model",
    "new": "new",
    "plan": "plan",
    "schema": "schema",
    "simulate": "simulate",
    "stylus": "stylus",
    "viewpoint": "viewpoint",
}
"""The file of each subcommand, by the word on the command line."""


class _Subcommands(Mapping[str, Any]):
    """The subcommands by name, each imported when it is asked for: a person runs one of them."""

    def __init__(self) -> None:
        self._loaded: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._loaded:
            self._loaded[name] = _imported_subcommand(name)
        return self._loaded[name]

    def __contains__(self, name: object) -> bool:
        return name in SUBCOMMANDS

    def get(self, name: str, default: Any = None) -> Any:
        """Return a subcommand; the default only for a word that is none."""
        # Mapping's own `get` would take any KeyError while a file is imported for a wrong word.
        return self[name] if name in SUBCOMMANDS else default

    def __iter__(self) -> Iterator[str]:
        return iter(SUBCOMMANDS)

    def __len__(self) -> int:
        return len(SUBCOMMANDS)


def _imported_subcommand(name: str) -> Any:
    """Return a subcommand with its options, from its file."""
    module = import_module(f".{SUBCOMMANDS[name]}", __package__)
    function = getattr(module, f"{name}_" if iskeyword(name) else name)
    # The whole first sentence, because a summary of click's own length is cut.
    summary = (inspect.getdoc(function) or "").partition("\n\n")[0]
    alone = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    alone.command(name, short_help=summary)(function)
    return typer.main.get_command(alone)


class _SmartviewGroup(TyperGroup):
    """The group of all subcommands, which sets the log level and collects garbage rarely."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = _Subcommands()

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
    cls=_SmartviewGroup,
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
            help="Log progress, and print the hand-eye transform as matrix, quaternion, roll, "
            "pitch and yaw (ROS) and in the robot's format; -vv also logs what JAX, OpenCV and "
            "other libraries report.",
        ),
    ] = 0,
) -> None:
    """Calibrate cameras on robot arms.

    Compiled programs are kept in ~/.cache/smartview_jax for the next run;
    JAX_COMPILATION_CACHE_DIR names another folder, JAX_ENABLE_COMPILATION_CACHE=0 turns this off.
    """
