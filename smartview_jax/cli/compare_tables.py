"""Print the comparison of methods so that every number can be read on a terminal of 80 columns."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.table import Table

from ..report import COMPARISON_HEADINGS, comparison_row

if TYPE_CHECKING:
    from ..evaluation import MethodResult

_TABLES = {
    "on the views that were fitted": ("mean +- std, px", "RMS, px", "left out points, views"),
    "on views that no fit saw": ("held out, px", "95 % interval, px", "held out, mm"),
}
"""The headings of each table, by its title; together they cover all numbers of a row."""


def print_comparison(rows: "Sequence[MethodResult]") -> None:
    """Print two tables with a row for each method: errors on fitted views, and on held-out ones.

    One table of all columns is wider than most terminals.
    """
    console = Console()
    # The report's own texts, so that page and terminal agree.
    texts = [
        dict[str, str](zip(COMPARISON_HEADINGS, comparison_row(row), strict=True)) for row in rows
    ]
    for title, headings in _TABLES.items():
        table = Table(
            "method", title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False
        )
        for heading in headings:
            # Headings and method names may wrap, but a number is never cut.
            parts = [*heading.split(), *(text[heading] for text in texts)]
            table.add_column(heading, justify="right", width=max(map(len, parts)))
        for text in texts:
            table.add_row(text["method"], *(text[heading] for heading in headings))
        console.print(table)
