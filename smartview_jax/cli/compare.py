"""Define `smartview compare`, which prints several methods side by side."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

import smartview_jax as sv

from . import options
from .documents import method_document, print_document, views_left_out
from .fit_options import FitKnowledge, parse_fit_options
from .load import load_named
from .options import with_option_groups
from .terminal import errors_reported, print_lines, progress_line


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
        given = {}
        with progress_line() as progress:
            if dataset is not None and sv.io.is_rig_folder(dataset):
                _refuse_knowledge(known, base_from_world, dataset)
                rig, name = sv.load_rig(dataset, bad_views, progress), dataset.resolve().name
                methods = sv.evaluation.standard_rig_methods(lens)
                data_of, rows_of = rig.cameras, sv.compare(rig, methods, progress=progress)
            else:
                data, name = load_named(dataset, bad_views, progress, base_from_world)
                fit_options = parse_fit_options(lens, data.mount, known)
                methods = sv.evaluation.standard_methods(lens, **fit_options.arguments())
                data_of, rows_of = {"": data}, {"": sv.compare(data, methods, progress=progress)}
                given = {"given": fit_options.given}
        if not json:
            for camera, data in data_of.items():
                title = ", ".join([name, *([f"camera {camera}"] if camera else []), f"lens {lens}"])
                _print(title, rows_of[camera], data.notes)
            return
        entries = {
            camera: {
                "methods": [method_document(row) for row in rows_of[camera]],
                "left_out_views": views_left_out(data.masked_views),
                # With --json nothing but the document is on stdout.
                "notes": list(data.notes),
            }
            for camera, data in data_of.items()
        }
        content = entries.get("", {"cameras": entries})
        print_document("compare", {"data_set": name, "lens": lens, **given, **content})


def _refuse_knowledge(known: FitKnowledge, base_from_world: str | None, dataset: Path) -> None:
    """Raise a ValueError for an option that the methods of several cameras do not have."""
    given = [name for name, value in dataclasses.asdict(known).items() if value is not None]
    given += ["base-from-world"] * (base_from_world is not None)
    if given:
        raise ValueError(f"--{given[0]}: not for several cameras, which {dataset} has")


def _print(title: str, rows: "Sequence[sv.evaluation.MethodResult]", notes: Sequence[str]) -> None:
    """Print the tables of a comparison, notes on the data, and remarks on the methods."""
    print_lines(title)
    print_comparison(rows)
    print_lines(*notes)
    for row in rows:
        held_out = None if row.held_out is None else sv.evaluation.HeldOutReport(row.held_out)
        print_lines(*sv.report.remarks(row.name, row.fitted, held_out, row.failure))


_TABLES = {
    "on the views that were fitted": {
        "mean +- std\npx": "mean +- std, px",
        "RMS\npx": "RMS, px",
        "left out\npoints,\nviews": "left out points, views",
    },
    "on views that no fit saw": {
        "RMS\npx": "held out, px",
        "95 % interval\npx": "95 % interval, px",
        "RMS\nmm": "held out, mm",
    },
}
"""The headings of each table and the report's headings for them, by the table's title.

Together they cover all numbers of a row.
"""


def print_comparison(rows: "Sequence[sv.evaluation.MethodResult]") -> None:
    """Print two tables with a row for each method: errors on fitted views, and on held-out ones.

    One table of all columns is wider than most terminals.
    """
    console = Console()
    # The report's own texts, so that page and terminal agree.
    texts = [
        dict[str, str](
            zip(sv.report.COMPARISON_HEADINGS, sv.report.comparison_row(row), strict=True)
        )
        for row in rows
    ]
    for title, headings in _TABLES.items():
        table = Table(
            "method", title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False
        )
        for heading, name in headings.items():
            # The names of methods may wrap, but a number or a line of a heading is never cut.
            parts = [*heading.splitlines(), *(text[name] for text in texts)]
            table.add_column(heading, justify="right", width=max(map(len, parts)))
        for text in texts:
            table.add_row(text["method"], *(text[name] for name in headings.values()))
        console.print(table)
