"""Figures of the smoke run against a committed baseline: has something become much worse?

`baseline.json` says for every figure what it was, which direction is better, and by what share it
may be worse before the run fails. Times are in it only as ratios to a peer in the same run.
"""

import json
from pathlib import Path

BASELINE = Path(__file__).parent / "baseline.json"


def check(figures: dict[str, float]) -> bool:
    """Print every figure and its baseline; True where none is worse than it may be."""
    known = json.loads(BASELINE.read_text(encoding="utf-8"))
    good = True
    for name, value in figures.items():
        if name not in known:
            print(f"{name:34}{value:10.3g}  not in the baseline")
            continue
        entry = known[name]
        worse = value / entry["value"] - 1.0
        if entry["better"] == "higher":
            worse = entry["value"] / value - 1.0
        fine = worse <= entry["tolerance"]
        good &= fine
        print(
            f"{name:34}{value:10.3g}  baseline {entry['value']:.3g}, {entry['better']} is better, "
            f"{entry['tolerance']:.0%} allowed{'' if fine else '  WORSE'}"
        )
    for name in sorted(set(known) - set(figures)):
        print(f"{name:34}   missing in this run")
    return good
