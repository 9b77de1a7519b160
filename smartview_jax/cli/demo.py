"""Define `smartview demo`, which runs a whole simulated cell and writes one page about it."""

import math
from pathlib import Path
from typing import Annotated

import typer

import smartview_jax as sv

from ..files import refuse_unwritable
from .options import DebugOption
from .terminal import errors_reported, print_lines, progress_line


def demo(
    out: Annotated[
        Path, typer.Option(help="Folder for the page and the model, such as demo.")
    ] = Path("demo"),
    seed: Annotated[
        int,
        typer.Option(
            help="Random seed of the cell and of how the objects fall, a number such as 3."
        ),
    ] = 0,
    views: Annotated[int, typer.Option(help="Number of pictures of the board, such as 16.")] = 16,
    debug: DebugOption = False,
) -> None:
    """Calibrate, model, localise, verify and grasp in a simulated cell, and write a page about it.

    The arm has errors, the lens distorts and objects fall by simulated gravity; the truth is used
    only to judge the result. It takes a few minutes.
    """
    with errors_reported(debug):
        refuse_unwritable(out, "--out")
        if views < 8:
            raise ValueError(f"--views: expected 8 or more, found {views}")
        try:
            with progress_line() as progress:
                result = sv.picking.run_demo(out, seed, views, progress)
        # A seed may let objects roll on, or place something out of the arm's reach.
        except sv.simulation.CellError as error:
            raise ValueError(f"--seed {seed}: the cell failed: {error}") from error
        print_lines(result.pick.outcome)
        held = f"in the hand after the lift: {'yes' if result.held else 'no'}"
        # Without a detection there is no position error.
        if math.isfinite(result.position_error):
            held += f"; position error {1e3 * result.position_error:.2f} mm"
        print_lines(held)
        typer.echo(f"{result.page}: the page")
        if not result.held:
            raise typer.Exit(1)
