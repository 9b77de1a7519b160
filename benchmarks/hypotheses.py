"""Known objects found in pictures without a start: are they among the ranked hypotheses, and when?

A hypothesis is right if it is within 2 degrees and 2 mm of the true pose, up to the object's
symmetry. First rendered scenes of five objects (two of them symmetric): alone, tilted as if leaning
on something, among clutter, and with about 30 % of their edges hidden; from two pictures of 1.2
megapixels and from one of them. Then the sets of real pictures, within 3 degrees and 5 mm of
reference poses that are themselves measured.
"""

import time
from typing import NamedTuple

import numpy as np

from smartview_jax.features import PictureEvidence, picture_evidence
from smartview_jax.localization import find_hypotheses
from smartview_jax.modeling import ObjectModel, SeenViews

from .localization_real import RealCase, real_cases
from .localization_scenes import KINDS, LocalizationScene, localization_scene, solids

NEAR = (2.0, 2e-3)
"""Largest errors of a right hypothesis: rotation in degrees, translation of the middle in m."""

REAL_NEAR = (3.0, 5e-3)
"""The same against reference poses, which are measured; the house is in units of its own."""

LISTED = 10
"""Length of the list in which a right hypothesis is looked for."""

GOALS = {"single": 0.97, "tilted": 0.97, "clutter": 0.97, "occluded": 0.9}
"""Smallest share of scenes with a right hypothesis in the list, from two pictures."""

MIN_REAL = 0.9
"""Smallest share of the real pictures, or pairs of them, with a right hypothesis in the list."""


class Search(NamedTuple):
    """The outcome of one search.

    Attributes:
        rank: place of the first right hypothesis, from 0; infinite where there is none.
        find_seconds, search_seconds: for the features of all pictures, and for the hypotheses.
    """

    rank: float
    find_seconds: float
    search_seconds: float


def pose_errors(
    model: ObjectModel, poses: np.ndarray, world_from_object: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (degrees) and translation of the object's middle (m), up to symmetry."""
    equal = world_from_object @ model.object_from_object
    cosines = np.einsum("pij,sij->ps", poses[:, :3, :3], equal[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((cosines - 1.0) / 2.0, -1.0, 1.0)))
    best = np.argmin(angles, axis=1)
    middle = np.append(model.vertices.mean(axis=0), 1.0)
    shifts = ((poses - equal[best]) @ middle)[:, :3]
    return angles.min(axis=1), np.linalg.norm(shifts, axis=1)


def search(
    evidence: list[PictureEvidence],
    views: SeenViews,
    model: ObjectModel,
    world_from_object: np.ndarray,
    near: tuple[float, float],
) -> tuple[float, float]:
    """Return the rank of the first right hypothesis, and the seconds of the search."""
    began = time.perf_counter()
    found = find_hypotheses(evidence, views, [model])
    seconds = time.perf_counter() - began
    if not found:
        return np.inf, seconds
    poses = np.array([result.world_from_object for result in found])
    angles, shifts = pose_errors(model, poses, world_from_object)
    right = np.flatnonzero((angles < near[0]) & (shifts < near[1]))
    return (float(right[0]) if len(right) else np.inf), seconds


def search_scene(scene: LocalizationScene, view_counts: tuple[int, ...]) -> dict[int, Search]:
    """Return the outcome of searches in one scene by the number of pictures."""
    began = time.perf_counter()
    evidence = [picture_evidence(picture, scene.calibration.camera) for picture in scene.pictures]
    seconds = (time.perf_counter() - began) / len(evidence)
    found = {}
    for count in view_counts:
        views = SeenViews.of(scene.calibration, scene.base_from_tool[:count])
        rank, taken = search(evidence[:count], views, scene.model, scene.world_from_object, NEAR)
        found[count] = Search(rank, count * seconds, taken)
    return found


def _row(name: str, views: int, found: list[Search], goal: float | None) -> bool:
    """Print a line of the table; return whether the goal is met."""
    ranks = np.array([result.rank for result in found])
    listed = (ranks < LISTED).mean()
    fine = goal is None or bool(listed >= goal)
    seconds = [float(np.median([result[k] for result in found])) for k in (1, 2)]
    print(
        f"{name:16}{views:6}{len(found):8}{(ranks == 0).mean():8.1%}{listed:9.1%}"
        f"{seconds[0]:10.2f}{seconds[1]:9.2f}{'' if fine else '  TOO FEW'}",
        flush=True,
    )
    return fine


def _scenes(smoke: bool) -> bool:
    """Print the table of rendered scenes; return whether the goals are met."""
    names, seeds, kinds = list(solids()), range(8), KINDS
    if smoke:
        names, seeds, kinds = ["stepped"], range(1), ("single", "occluded")
    print(
        f"{'scenes':16}{'views':>6}{'number':>8}{'first':>8}{f'in {LISTED}':>9}"
        f"{'find, s':>10}{'search':>9}"
    )
    good = True
    for kind in kinds:
        found = [
            search_scene(localization_scene(name, kind, seed), (2, 1))
            for seed in seeds
            for name in names
        ]
        good &= _row(kind, 2, [result[2] for result in found], GOALS[kind])
        # One picture alone cannot tell a small near block from a large far one: no goal.
        _row(kind, 1, [result[1] for result in found], None)
    return good


def _real(smoke: bool) -> bool:
    """Print the table of real pictures; return whether the goal is met."""
    cases = real_cases()
    if not cases:
        print("real pictures skipped: not next to this checkout (shared/data)")
        return True
    found: dict[str, list[Search]] = {}
    case_views: dict[str, int] = {}
    for case in cases[::6] if smoke else cases:
        kind = " ".join(case.name.split()[:2])
        case_views[kind] = len(case.pictures)
        found.setdefault(kind, []).append(_search_real(case))
    for name, searches in found.items():
        _row(name[:15], case_views[name], searches, None)
    every = [result.rank for searches in found.values() for result in searches]
    share = float((np.array(every) < LISTED).mean())
    print(f"real cases with a right hypothesis in {LISTED}: {share:.1%} of {len(every)}")
    return share >= MIN_REAL


def _search_real(case: RealCase) -> Search:
    """Return the outcome of the search in one real case."""
    began = time.perf_counter()
    evidence = [picture_evidence(picture, case.calibration.camera) for picture in case.pictures]
    seconds = time.perf_counter() - began
    views = SeenViews.of(case.calibration, case.poses)
    near = REAL_NEAR[0], REAL_NEAR[1] * case.unit
    rank, taken = search(evidence, views, case.model, case.world_from_object, near)
    return Search(rank, seconds, taken)


def run(smoke: bool = False) -> bool:
    """Print the tables; True where every goal is met. `smoke` takes one object and few pictures."""
    good = _scenes(smoke)
    return _real(smoke) and good
