"""The comparison of methods can be read on a terminal of 80 columns, with every number whole."""

import numpy as np
import pytest

from smartview_jax.cli.compare import print_comparison
from smartview_jax.evaluation import HeldOutErrors, MethodResult, ReprojectionErrors
from smartview_jax.fit_result import Rejection
from smartview_jax.report import comparison_row

LONGEST = "joint, errors estimated, without correction"


def result(name, px):
    """Errors of two views, one worse than the other, and larger where no fit saw them."""
    spread, metres = np.array([[1.0, 2.0], [3.0, 4.0]]), np.full((2, 2), 2e-3)
    unseen = ReprojectionErrors(1.7 * px * spread, metres)
    held_out = HeldOutErrors(unseen, ((0,), (1,)), ())
    return MethodResult(name, ReprojectionErrors(px * spread, metres), held_out, ())


@pytest.mark.parametrize("columns", ["80", "60"])
def test_every_number_is_whole_on_a_narrow_terminal(capsys, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    left_out = tuple(Rejection(str(k), None, "off") for k in range(100))
    rows = [
        # As large as a fit that went wrong has them: 1.23e+03 is eight characters.
        result(LONGEST, 1234.5)._replace(rejected=left_out),
        result("staged", 0.1234),
        MethodResult("one view's intrinsics", None, None, failure="no view is good enough"),
    ]
    print_comparison(rows)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= int(columns)
    for row in rows[:2]:
        cells = comparison_row(row)[1:]
        assert len(set(cells)) == len(cells)
        shown = [line for line in lines if cells[0] in line or cells[3] in line]
        assert len(shown) == 2
        for cell in cells:
            assert any(cell in line for line in shown), cell
    # Headings are not cut at the width of small numbers.
    print_comparison([result("staged", 0.9)])
    assert "95 % interval" in capsys.readouterr().out
    failed = next(line for line in lines if "one view" in line)
    assert failed.split()[-3:] == ["failed", "-", "-"]
