"""How time and memory grow with points, views and devices: one process a row, nothing else in it.

What a process holds before it has any data is in the first row, which is all but empty; the
column "added" is what a row has beyond it, as a multiple of its input.
"""

import tempfile
from pathlib import Path

from .engine import measured, median, python
from .peers.problem import make

SIZES = ((5, 100), (500, 1000), (500, 10000), (5000, 1000))
SMOKE = ((5, 100), (20, 500))


def run(smoke: bool = False) -> bool:
    """Print the table; True where the largest problem adds at most three times its input."""
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
