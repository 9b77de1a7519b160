"""How time and memory grow with points, views and devices: one process a row, nothing else in it.

What a process holds before it has any data is in the first row, which is all but empty; the
column "added" is what a row has beyond it, as a multiple of its input. The second table is the
whole default calibration, `sv.calibrate`, whose time and memory must grow as the views do.
"""

import sys
import tempfile
from pathlib import Path

from .engine import measured, median, python
from .peers.problem import make

SIZES = ((5, 100), (500, 1000), (500, 10000), (5000, 1000))
SMOKE = ((5, 100), (20, 500))


VIEWS = (15, 100, 500, 2000)
SMOKE_VIEWS = (15,)
"""Numbers of views of the default calibration, of 63 points each."""

LARGEST_TIME_RATIO, LARGEST_PEAK = 5.0, 1500.0
"""Largest ratio of the time for 2,000 views to the time for 500, and largest peak memory in MB."""


def run(smoke: bool = False) -> bool:
    """Print the tables; True where memory and time grow as they may.

    The largest problem adds at most three times its input, and four times the views take at most
    five times as long.
    """
    solved, calibrated = _solving(smoke), _calibrating(SMOKE_VIEWS if smoke else VIEWS)
    return solved and calibrated


def _calibrating(sizes: tuple[int, ...]) -> bool:
    """Print time and memory of the default calibration by views; True where both are linear."""
    print(f"\n{'views':>6}{'points':>10}{'peak MB':>9}{'seconds':>10}{'ms a view':>12}")
    seconds, peaks = {}, {}
    for views in sizes:
        command = [sys.executable, "-m", "benchmarks.peers.smartview_calibrate", str(views), "3"]
        found = measured(command)
        seconds[views], peaks[views] = median([found], "seconds"), found["peak_mb"]
        print(
            f"{views:6}{views * 63:10}{peaks[views]:9.0f}{seconds[views]:10.2f}"
            f"{1e3 * seconds[views] / views:12.2f}",
            flush=True,
        )
    if 2000 not in sizes:
        return True
    ratio = seconds[2000] / seconds[500]
    print(f"2,000 views take {ratio:.1f} times as long as 500")
    return ratio <= LARGEST_TIME_RATIO and peaks[2000] <= LARGEST_PEAK


def _solving(smoke: bool) -> bool:
    """Print the table of solves; True where the largest adds at most three times its input."""
    print(
        f"{'views':>6}{'points':>10}{'devices':>9}{'input MB':>10}{'peak MB':>9}{'added':>7}"
        f"{'seconds':>10}{'ns a point':>12}"
    )
    added = 0.0
    empty = None
    with tempfile.TemporaryDirectory() as folder:
        for views, count in SMOKE if smoke else SIZES:
            path = Path(folder) / "problem.f64"
            make(views, count, False).save(path)
            for devices in (1, 2):
                ours = python("smartview", "forward", "solve", str(devices))
                found = measured(ours(path, 2 if smoke else 3))
                seconds, peak = median([found], "seconds"), found["peak_mb"]
                # Points, pixels, visibility of every view, as the fit holds them.
                size = views * count * (24 + 16 + 1) / 2**20
                empty = peak if empty is None else empty
                added = (peak - empty) / size
                each = seconds / found["iterations"] / (views * count) * 1e9
                print(
                    f"{views:6}{views * count:10}{devices:9}{size:10.1f}{peak:9.0f}"
                    f"{f'{added:7.2f}' if size > 1.0 else '      -'}"
                    f"{seconds:10.4f}{each:12.1f}"
                )
            path.unlink()
    return smoke or added <= 3.0
