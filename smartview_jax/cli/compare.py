"""Define `smartview compare`, which prints several methods side by side."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from . import options
from .error_documents import method_document, views_left_out
from .fit_options import FitKnowledge, parse_fit_options
from .json_document import print_document
from .load import load_named
from .options import with_option_groups
from .terminal import errors_reported, progress_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..evaluation import MethodResult


@with_option_groups
def compare(
    dataset: options.DatasetArgument = None,
    lens: options.LensOption = "opencv4",
    *,
    known: FitKnowledge,
    bad_views: options.BadViewsOption = options.BadViews.RAISE,
    base_from_world: options.BaseFromWorldOption = None,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Print staged, no-distortion, interpolation, one-view and joint fits side by side.

    For a folder with several cameras, print fits of each camera alone and of all together.
    """
    with errors_reported(debug):
        from ..evaluation import compare as compare_methods
        from ..evaluation import standard_methods
        from ..io import is_rig_folder

        if dataset is not None and is_rig_folder(dataset):
            given = [name for name, value in dataclasses.asdict(known).items() if value is not None]
            given += ["base-from-world"] * (base_from_world is not None)
            if given:
                raise ValueError(f"--{given[0]}: not for several cameras, which {dataset} has")
            _compare_rig(dataset, lens, bad_views, json)
            return
        with progress_line() as progress:
            data, name = load_named(dataset, bad_views, progress, base_from_world)
            fit_options = parse_fit_options(lens, data.mount, known)
            methods = standard_methods(lens, **fit_options.arguments())
            rows = compare_methods(data, methods, progress=progress)
        if json:
            content = {
                "data_set": name,
                "lens": lens,
                "given": fit_options.given,
                "methods": [method_document(row) for row in rows],
                "left_out_views": views_left_out(data.masked_views),
                # With --json nothing but the document is on stdout.
                "notes": list(data.notes),
            }
            print_document("compare", content)
            return
        _print(f"{name}, lens {lens}", rows, data.notes)


def _compare_rig(folder: Path, lens: str, bad_views: str, json: bool) -> None:
    """Print the methods of each camera of a rig side by side: fitted alone, and all together.

    Args:
        folder: data-set folder with several cameras.
        lens: lens model of all cameras.
        bad_views: as in `load_rig`.
        json: whether to print a document for programs.
    """
    from ..evaluation import compare as compare_methods
    from ..evaluation import standard_rig_methods
    from ..io import load_rig

    with progress_line() as progress:
        rig = load_rig(folder, bad_views, progress)
        rows = compare_methods(rig, standard_rig_methods(lens), progress=progress)
    name, cameras = folder.resolve().name, rig.cameras.items()
    if json:
        content = {
            "data_set": name,
            "lens": lens,
            "cameras": {
                camera: {
                    "methods": [method_document(row) for row in rows[camera]],
                    "left_out_views": views_left_out(data.masked_views),
                    "notes": list(data.notes),
                }
                for camera, data in cameras
            },
        }
        print_document("compare", content)
        return
    for camera, data in cameras:
        _print(f"{name}, camera {camera}, lens {lens}", rows[camera], data.notes)


def _print(title: str, rows: "Sequence[MethodResult]", notes: "Sequence[str]") -> None:
    """Print the tables of a comparison, notes on the data, and remarks on the methods."""
    from rich.console import Console

    from ..evaluation import HeldOutReport
    from ..report import remarks
    from .compare_tables import print_comparison

    console = Console()
    console.print(title, highlight=False, markup=False)
    print_comparison(rows)
    for note in notes:
        console.print(note, highlight=False, markup=False)
    for row in rows:
        held_out_report = None if row.held_out is None else HeldOutReport(row.held_out)
        for remark in remarks(row.name, row.fitted, held_out_report, row.failure):
            console.print(remark, highlight=False, markup=False)
