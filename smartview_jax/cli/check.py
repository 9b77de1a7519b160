"""Define `smartview check`, which looks at a data set before anything is calibrated with it."""

from typing import TYPE_CHECKING

import typer

from .load import load_named
from .options import BadViews, BadViewsOption, DatasetArgument, DebugOption
from .terminal import errors_reported, progress_line

if TYPE_CHECKING:
    from ..dataset import Dataset

MIN_VIEWS = 10
"""Number of usable views below which more are asked for."""

MIN_TURN = 30.0
"""Largest rotation between two views, degrees, below which more different ones are asked for."""

MIN_FILLED = 0.25
"""Smallest share of the picture that all points together should cover."""


def check(
    dataset: DatasetArgument = None,
    bad_views: BadViewsOption = BadViews.MASK,
    debug: DebugOption = False,
) -> None:
    """Check a data set: pictures, detections, poses, and whether camera and robot agree.

    Exits with 1 if the data cannot be calibrated as they are.
    """
    with errors_reported(debug):
        with progress_line() as progress:
            data, name = load_named(dataset, bad_views, progress)
        typer.echo(f"{name}: {data.view_count} views, {data.mount}")
        for note in data.notes:
            typer.echo(note)
        for text in (*_seen(data), *_motion(data)):
            typer.echo(text)
        problems = _contradictions(data)
        for text in problems:
            typer.echo(f"problem: {text}")
        if problems:
            raise typer.Exit(1)
        typer.echo("camera and robot agree: smartview calibrate can begin")


def _seen(data: "Dataset") -> list[str]:
    """Return what was detected: points by view, views without any, how much of the picture."""
    import numpy as np

    visible = np.asarray(data.visible)
    counts = visible.sum(axis=1)
    lines = [
        f"points seen in a view: {counts.min()} to {counts.max()}, median {np.median(counts):.0f}"
    ]
    lines += [f"  view {view} is left out: {reason}" for view, reason in data.masked_views]
    pixels = np.asarray(data.pixels)[visible]
    if len(pixels):
        # Cells of a grid that any point falls into.
        cells = np.floor(8 * pixels / np.array(data.image_size)).clip(0, 7).astype(int)
        filled = len(np.unique(cells, axis=0)) / 64
        advice = ": move the target to the borders too" if filled < MIN_FILLED else ""
        lines.append(f"part of the picture that was used: {filled:.0%}{advice}")
    return lines


def _motion(data: "Dataset") -> list[str]:
    """Return how far and how differently the robot moved between the views."""
    import numpy as np

    from ..geometry import host_matrices

    used = data.usable_views()
    if len(used) < 2:
        return [f"usable views: {len(used)}; take more"]
    poses = host_matrices(data.base_from_tool)[used]
    extent = np.ptp(poses[:, :3, 3], axis=0)
    # trace(R_i^T R_j) = 1 + 2 cos(angle between them)
    traces = np.einsum("iab,jab->ij", poses[:, :3, :3], poses[:, :3, :3])
    largest = float(np.rad2deg(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)).max()))
    return [
        f"usable views: {len(used)}" + ("; take more" if len(used) < MIN_VIEWS else ""),
        f"the tool moved by {', '.join(f'{1e3 * x:.0f}' for x in extent)} mm along x, y, z",
        f"largest rotation between two views: {largest:.0f} degrees"
        + ("; turn the tool more" if largest < MIN_TURN else ""),
    ]


def _contradictions(data: "Dataset") -> tuple[str, ...]:
    """Return why pictures and poses cannot belong together; empty if they do."""
    from ..staged import fit_staged

    try:
        fit = fit_staged(data, "opencv4", conventions="report")
    except ValueError as error:
        return (str(error),)
    return fit.conventions.problems
