"""Read the options and the data sets of `smartview calibrate`."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

import smartview_jax as sv

from . import options
from .fit_options import FitKnowledge
from .load import load_named, load_samples, with_estimated_clock


@dataclass(frozen=True)
class CalibrateSettings:
    """The options of `smartview calibrate` that are the same for all folders."""

    lens: options.LensOption = "opencv4"
    noise: options.NoiseOption = options.NoiseModel.ESTIMATED
    held_out: Annotated[
        bool,
        typer.Option(
            help="Cross-validate: refit without some views and measure the error on them.",
            show_default="on",
        ),
    ] = True
    diagnose: Annotated[
        bool,
        typer.Option(
            help="Also: error by workspace region, split-half agreement, error budget.",
            show_default="off",
        ),
    ] = False
    known: FitKnowledge = field(default_factory=FitKnowledge)
    bad_views: options.BadViewsOption = options.BadViews.RAISE
    base_from_world: options.BaseFromWorldOption = None
    time_offset: options.TimeOffsetOption = False
    mount: options.MountOption = None


def loaded_folder(
    dataset: Path | None, settings: CalibrateSettings, progress: Callable[[str], None]
) -> "tuple[sv.Dataset, str]":
    """Load a data set, with poses at the estimated clock if requested, and return its name too."""
    if dataset is not None and dataset.is_file():
        for option, is_given in (
            ("--base-from-world", settings.base_from_world is not None),
            ("--time-offset", settings.time_offset),
        ):
            if is_given:
                raise ValueError(f"{option}: expected a data-set folder, found the file {dataset}")
        return load_samples(dataset, settings.mount and settings.mount.value)
    if settings.mount is not None:
        raise ValueError("--mount: expected a file of samples; a data-set folder states its mount")
    data, name = load_named(
        dataset, settings.bad_views, progress, settings.base_from_world, tracked_poses=True
    )
    if settings.time_offset:
        data = with_estimated_clock(data, dataset, settings.lens, progress)
    return data, name
