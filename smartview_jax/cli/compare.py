"""Define `smartview compare`, which prints several methods side by side."""

from . import fit_options, options
from .error_documents import method_document, views_left_out
from .json_document import print_document
from .load import load_named
from .terminal import errors_reported, progress_line


def compare(
    dataset: options.DatasetArgument = None,
    lens: options.LensOption = "opencv4",
    camera: fit_options.CameraOption = None,
    fixed: fit_options.FixedOption = None,
    free: fit_options.FreeOption = None,
    prior: fit_options.PriorOption = None,
    start: fit_options.StartOption = None,
    bad_views: options.BadViewsOption = options.BadViews.RAISE,
    base_from_world: options.BaseFromWorldOption = None,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Print staged, no-distortion, interpolation, one-view and joint fits side by side."""
    with errors_reported(debug):
        from rich.console import Console

        from ..evaluation import HeldOutReport, standard_methods
        from ..evaluation import compare as compare_methods
        from ..report import remarks
        from .compare_tables import print_comparison

        with progress_line() as progress:
            data, name = load_named(dataset, bad_views, progress, base_from_world)
            known = fit_options.parse_fit_options(
                lens, data.mount, camera, fixed, free, prior, start
            )
            methods = standard_methods(lens, **known.arguments())
            rows = compare_methods(data, methods, progress=progress)
        # The same numbers as in the tables, unrounded.
        if json:
            entries = [method_document(row) for row in rows]
            left_out = views_left_out(data.masked_views)
            content = {"data_set": name, "lens": lens, "given": known.given, "methods": entries}
            # Notes are in the document: nothing but it is on stdout.
            notes = {"left_out_views": left_out, "notes": list(data.notes)}
            print_document("compare", content | notes)
            return
        console = Console()
        console.print(f"{name}, lens {lens}", highlight=False, markup=False)
        print_comparison(rows)
        for note in data.notes:
            console.print(note, highlight=False)
        for row in rows:
            held_out_report = None if row.held_out is None else HeldOutReport(row.held_out)
            for remark in remarks(row.name, row.fitted, held_out_report, row.failure):
                console.print(remark, highlight=False)
