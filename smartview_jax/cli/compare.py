"""Define `smartview compare`, which prints several methods side by side."""

from . import options
from .error_documents import method_document, views_left_out
from .fit_options import FitKnowledge, parse_fit_options
from .json_document import print_document
from .load import load_named
from .option_groups import with_option_groups
from .terminal import errors_reported, progress_line


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
    """Print staged, no-distortion, interpolation, one-view and joint fits side by side."""
    with errors_reported(debug):
        from rich.console import Console

        from ..evaluation import HeldOutReport, standard_methods
        from ..evaluation import compare as compare_methods
        from ..report import remarks
        from .compare_tables import print_comparison

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
        console = Console()
        console.print(f"{name}, lens {lens}", highlight=False, markup=False)
        print_comparison(rows)
        for note in data.notes:
            console.print(note, highlight=False, markup=False)
        for row in rows:
            held_out_report = None if row.held_out is None else HeldOutReport(row.held_out)
            for remark in remarks(row.name, row.fitted, held_out_report, row.failure):
                console.print(remark, highlight=False, markup=False)
