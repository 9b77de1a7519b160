"""Print the tables of the localisation benchmark from its records."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from smartview_jax.evaluation import mean_nees

from .grasping import interval

GOALS = {"single": 0.97, "occluded": 0.9}
"""Smallest recall by kind of scene."""

MAX_FALSE_ACCEPTS = 0.005
"""Largest share of searches in which a wrong pose is accepted."""

MAX_OVER_BOUND = 1.3
"""Largest ratio of the poses' RMS error to the Cramer-Rao bound."""

MAX_SECONDS = 1.5
"""Largest median of the seconds a scene, warm."""

CALIBRATIONS = ("true", "joint", "staged")

AFTER_THIRD = "true, 3 views"
"""The true calibration, with a third view of the scenes in which two leave a pose open."""

HIDDEN_BANDS = ((0.0, 0.1), (0.1, 0.25), (0.25, 0.4), (0.4, 0.6))
"""Shares of hidden edges by which the objects in the bin are told apart."""


class SceneSeconds(NamedTuple):
    """What one scene takes.

    Attributes:
        localize: time of the whole search, s.
        detector: time of OpenCV's line segment detector on the same pictures, s, which tells how
            fast the machine is.
    """

    localize: float
    detector: float


def print_tables(records: list[dict[str, Any]], smoke: bool = False) -> bool:
    """Print all tables; True where every goal is met, in a smoke run whether nothing is wrong."""
    if not records:
        print("no records")
        return False
    print(f"{len(records)} scenes, {len({r['cell'] for r in records})} cells")
    similar = [r for r in records if r["kind"] == "similar"]
    records = [r for r in records if r["kind"] != "similar"]
    recalls = _print_recall(records)
    wrong = _print_false_accepts(records)
    _print_similar(similar)
    ratio = _print_accuracy(records)
    _print_peers(records)
    _print_third_views(records)
    if smoke:
        return wrong == 0
    good = all(recalls[kind] >= goal for kind, goal in GOALS.items() if kind in recalls)
    return good and wrong <= MAX_FALSE_ACCEPTS and ratio <= MAX_OVER_BOUND


def print_seconds(seconds: list[SceneSeconds]) -> bool:
    """Print the times of scenes; True where the goal is met."""
    own = [scene.localize for scene in seconds]
    ratios = [scene.localize / scene.detector for scene in seconds]
    print(f"seconds a scene, warm, one model, two pictures: median {np.median(own):.2f}, "
          f"largest {max(own):.2f}; {np.median(ratios):.0f} times as long as OpenCV's "
          "line segment detector on these pictures")  # fmt: skip
    return float(np.median(own)) <= MAX_SECONDS


def _judged(record: dict[str, Any], column: str) -> list[dict[str, Any]]:
    """Return what was found in a scene by one of `CALIBRATIONS`, or after a third view."""
    if column == AFTER_THIRD:
        return record.get("third", {}).get("chosen", record["true"])
    return record[column]


def _found(record: dict[str, Any], column: str) -> set[int]:
    """Return which of the objects of a scene are accepted where they are."""
    return {
        one["object"]
        for one in _judged(record, column)
        if one["decision"] == "accepted" and one["right"]
    }


def _print_recall(records: list[dict[str, Any]]) -> dict[str, float]:
    """Print recall by kind of scene; return it for the true calibration, with verification."""
    columns = (*CALIBRATIONS, AFTER_THIRD)
    head = "".join(f"{name:>14}" for name in columns)
    print(f"\n{'recall of objects':26}{'objects':>8}{head}   95 % interval, {AFTER_THIRD}")
    recalls = {}

    def row(name: str, objects: list[tuple[dict[str, Any], int]]) -> float:
        if not objects:
            return np.nan
        hits = [sum(k in _found(r, c) for r, k in objects) for c in columns]
        low, high = interval(hits[-1], len(objects))
        shares = "".join(f"{hit / len(objects):14.1%}" for hit in hits)
        print(f"{name:26}{len(objects):8}{shares}   {low:.1%} to {high:.1%}")
        return hits[-1] / len(objects)

    for kind in ("single", "occluded", "clutter", "bin"):
        own = [(r, k) for r in records if r["kind"] == kind for k in range(len(r["objects"]))]
        recalls[kind] = row(kind, own)
        if kind == "bin":
            for low, high in HIDDEN_BANDS:
                band = [(r, k) for r, k in own if low <= np.mean(r["hidden"][k]) < high]
                row(f"  of it {low:.0%} to {high:.0%} hidden", band)
    return {kind: value for kind, value in recalls.items() if np.isfinite(value)}


def _print_false_accepts(records: list[dict[str, Any]]) -> float:
    """Print how often a wrong pose is accepted; return the largest share by a true calibration."""
    print("\nfalse accepts             accepted   wrong   of accepted     of searches (95 %)")
    shares = {}
    for name in (*CALIBRATIONS, AFTER_THIRD):
        results = [one for r in records for one in _judged(r, name)]
        accepted = [one for one in results if one["decision"] == "accepted"]
        wrong = sum(not one["right"] for one in accepted)
        searches = sum(_searches(r) for r in records)
        low, high = interval(wrong, searches)
        shares[name] = wrong / max(searches, 1)
        print(
            f"{name:26}{len(accepted):8}{wrong:8}{wrong / max(len(accepted), 1):14.2%}"
            f"   {wrong}/{searches}: {low:.2%} to {high:.2%}"
        )
    return max(shares["true"], shares[AFTER_THIRD])


def _print_similar(records: list[dict[str, Any]]) -> None:
    """Print in how many scenes of solids like it an object is accepted that is not there."""
    if not records:
        return
    shares = []
    for name in CALIBRATIONS:
        wrong = sum(any(o["decision"] == "accepted" for o in r[name]) for r in records)
        low, high = interval(wrong, len(records))
        shares.append(f"{name} {wrong}/{len(records)} ({low:.1%} to {high:.1%})")
    print(f"at solids like it but for one or two sizes accepted: {', '.join(shares)}")


def _searches(record: dict[str, Any]) -> int:
    """Return how many models are looked for in a scene."""
    return 2 if record["kind"] in ("wrong", "empty") else len(set(record["objects"])) + 1


def _print_accuracy(records: list[dict[str, Any]]) -> float:
    """Print errors, NEES and ratios to the bounds; return the larger one to that without grain."""
    print(
        "\npose of accepted objects        number  median mm  RMS mm  median deg   NEES of 6 (band)"
    )
    for name in CALIBRATIONS:
        own = [o for r in records for o in r[name] if o["decision"] == "accepted" and o["right"]]
        if not own:
            continue
        mm, degrees = (np.array([one[key] for one in own]) for key in ("mm", "degrees"))
        squares = np.array([one["nees"] for one in own])
        mean = mean_nees(squares, 6)
        print(
            f"{name:32}{len(own):6}{np.median(mm):11.4f}{np.sqrt(np.mean(mm**2)):8.3f}"
            f"{np.median(degrees):12.4f}   {mean.value:.2f} ({mean.low:.2f} to {mean.high:.2f}), "
            f"median {np.median(squares):.2f}"
        )
    bounds = [one for r in records for one in r["bound"]]
    strict = _print_over_bound(bounds, "points_", "of the points' noise alone")
    _print_over_bound(bounds, "grain_", "of noise and grain")
    return strict


def _print_over_bound(bounds: list[dict[str, float]], prefix: str, name: str) -> float:
    """Print the ratios of errors to one of the bounds; return the larger one of the RMS errors."""
    worst = 0.0
    # Records of earlier runs have another bound.
    known = [one for one in bounds if f"{prefix}mm" in one]
    for unit in ("mm", "degrees"):
        own, least = (
            np.array([one[key] for one in known]) for key in (f"own_{unit}", prefix + unit)
        )
        if len(own):
            ratio = float(np.sqrt(np.mean(own**2) / np.mean(least**2)))
            typical = float(np.median(own / least))
            worst = max(worst, ratio)
            print(
                f"RMS error over the bound {name}, {unit}: {np.sqrt(np.mean(own**2)):.4f} / "
                f"{np.sqrt(np.mean(least**2)):.4f} = {ratio:.2f}; median of ratios {typical:.2f}"
            )
    return worst


def _print_peers(records: list[dict[str, Any]]) -> None:
    """Print OpenCV's poses from the same matched corners next to ours."""
    peers = [(o, b) for r in records for o, b in zip(r["pnp"], r["bound"], strict=True)]
    solved = [(o, b) for o, b in peers if o.get("solved")]
    if not solved:
        return
    mm, degrees = (np.array([o[key] for o, _ in solved]) for key in ("mm", "degrees"))
    near = (mm < 5.0) & (degrees < 3.0)
    own = (
        np.array([b["own_mm"] for _, b in solved]),
        np.array([b["own_degrees"] for _, b in solved]),
    )
    print(
        f"\nsolvePnPRansac on our matched corners: {len(solved)} of {len(peers)} solved, "
        f"{near.mean():.1%} of these right; median {np.median(mm):.3f} mm, "
        f"{np.median(degrees):.3f} deg; ours on these {np.median(own[0]):.4f} mm, "
        f"{np.median(own[1]):.4f} deg"
    )


def _print_third_views(records: list[dict[str, Any]]) -> None:
    """Print what the paper's verification view and the chosen one make of the same scenes."""
    own = [r for r in records if {"chosen", "paper"} <= set(r.get("third", {}))]
    if not own:
        return

    def accepted(results: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
        return [one for one in results if one["decision"] == "accepted"]

    def count(name: str, test: Callable[[dict[str, Any]], bool]) -> int:
        return sum(test(one) for r in own for one in accepted(r["third"][name]))

    print(
        f"\nthird views of {len(own)} scenes    objects accepted   wrong   median mm  views a scene"
    )
    for name in ("before", "chosen", "paper"):
        errors = [o["mm"] for r in own for o in accepted(r["third"][name]) if o["right"]]
        right = count(name, lambda one: one["right"])
        wrong = count(name, lambda one: not one["right"])
        # Two suffice where they accept; a third is taken where they do not; four where it does not.
        needed = [
            2 if accepted(r["third"]["before"]) else 3 if accepted(r["third"][name]) else 4
            for r in own
        ]
        text = "" if name == "before" else f"{np.mean(needed):14.2f}"
        median = np.median(errors) if errors else np.nan
        print(f"{name:28}{right:18}{wrong:8}{median:12.4f}{text}")
