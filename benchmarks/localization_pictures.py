"""Known objects judged in real pictures: found where they are, refused where they are not.

Each set is asked for its own object, and for others that are not there, brought to the size of its
own: solids of the rendered scenes. A pose is right near a reference of others, up to symmetry.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from smartview_jax.features import PictureEvidence, picture_evidence
from smartview_jax.localization import Localization, localize
from smartview_jax.modeling import ObjectModel
from smartview_jax.simulation import Polyhedron

from .grasping import interval
from .hypotheses import REAL_NEAR, pose_errors
from .localization_real import RealCase, real_cases
from .localization_scenes import solids

ABSENT = ("stepped", "roofed", "random12", "random14")
"""The solids that are on none of the pictures; a box is a cube or a tower but for its lengths."""

MAX_EDGE_RMS = 1.5
"""Largest RMS distance of a found wireframe from the pictures' edges, px."""

SMOKE_EVERY = 20
"""Of so many cases a smoke run takes one: a pair of the castle, and a picture of the cube."""


class Finding(NamedTuple):
    """What was found of an object that is in the pictures.

    Attributes:
        accepted, best_is_right: whether its right pose was accepted, and whether it was the first
            that was reported.
        wrong: number of wrong poses that were accepted.
        edge_rms: distance of the wireframe from the pictures' edges, px; NaN if not accepted.
        degrees, relative: errors of the accepted pose; the second over the object's extent.
    """

    accepted: bool
    best_is_right: bool
    wrong: int
    edge_rms: float
    degrees: float
    relative: float


def print_real_pictures(smoke: bool = False) -> bool:
    """Print what is found in real pictures; True where every goal is met or the sets are not there.

    A smoke run takes few pictures.
    """
    cases = real_cases()[:: SMOKE_EVERY if smoke else 1]
    if not cases:
        print("\nreal pictures skipped: not next to this checkout (shared/data)")
        return True
    print(
        f"\n{'real pictures':20}{'cases':>6}{'accepted':>10}{'right first':>13}{'wrong':>7}"
        f"{'edges px':>10}{'degrees':>9}{'of size':>9}{'absent':>9}{'accepted':>10}"
    )
    good, absent_accepted, absent_searched = True, 0, 0
    for name in dict.fromkeys(_set_of(case) for case in cases):
        own = [case for case in cases if _set_of(case) == name]
        findings, accepted, searched = [], 0, 0
        for case in own:
            evidence = [
                picture_evidence(picture, case.calibration.camera) for picture in case.pictures
            ]
            findings.append(_present(case, evidence))
            absent = _absent(case, evidence, ABSENT[: 1 if smoke else None])
            accepted, searched = accepted + sum(absent), searched + len(absent)
        _print_row(name, findings, accepted, searched)
        good &= all(
            finding.accepted and not finding.edge_rms > MAX_EDGE_RMS for finding in findings
        )
        good &= not any(finding.wrong for finding in findings)
        absent_accepted, absent_searched = absent_accepted + accepted, absent_searched + searched
    low, high = interval(absent_accepted, absent_searched)
    print(f"of objects that are not there {absent_accepted} of {absent_searched} were accepted: "
          f"{low:.1%} to {high:.1%}")  # fmt: skip
    return good and absent_accepted == 0


def _set_of(case: RealCase) -> str:
    """Return the object and how many pictures show it."""
    count = len(case.pictures)
    what = case.name.split()[0] if case.name.startswith(("cube", "house")) else case.model.name
    return f"{what}, {count} picture{'s' if count > 1 else ''}"


def _present(case: RealCase, evidence: Sequence[PictureEvidence]) -> Finding:
    """Return what is found of the object that the pictures show."""
    localizations = localize(evidence, case.poses, case.calibration, case.model)
    right = [obj for obj in localizations.accepted if _error(case, obj)[2]]
    first = bool(len(localizations)) and _error(case, localizations[0])[2]
    wrong = len(localizations.accepted) - len(right)
    if not right:
        return Finding(False, first, wrong, np.nan, np.nan, np.nan)
    angle, shift, _ = _error(case, right[0])
    rms = right[0].verdict.evidence.edge_rms
    return Finding(True, first, wrong, rms, angle, shift / _extent(case.model.vertices))


def _error(case: RealCase, obj: Localization) -> tuple[float, float, bool]:
    """Return degrees and length from the reference pose, and whether that is right."""
    angle, shift = (
        float(x[0])
        for x in pose_errors(case.model, obj.world_from_object[None], case.world_from_object)
    )
    return angle, shift, angle < REAL_NEAR[0] and shift < REAL_NEAR[1] * case.unit


def _absent(
    case: RealCase, evidence: Sequence[PictureEvidence], names: Sequence[str]
) -> list[bool]:
    """Return which objects that the pictures do not show are accepted all the same."""
    size = _extent(case.model.vertices)
    models = [_of_size(solids()[name], name, size) for name in names]
    return [
        bool(len(localize(evidence, case.poses, case.calibration, model).accepted))
        for model in models
    ]


def _of_size(solid: Polyhedron, name: str, size: float) -> ObjectModel:
    """Return the model of a solid brought to an extent."""
    scaled = solid._replace(vertices=solid.vertices * (size / _extent(solid.vertices)))
    return scaled.exact_model(name)


def _extent(vertices: np.ndarray) -> float:
    """Return the largest size of an object along an axis."""
    return float(np.ptp(vertices, axis=0).max())


def _print_row(name: str, findings: Sequence[Finding], accepted: int, searched: int) -> None:
    """Print the results for one object, with medians over accepted poses."""
    found = [finding for finding in findings if finding.accepted]
    rms, angle, shift = (
        np.median([getattr(finding, key) for finding in found]) if found else np.nan
        for key in ("edge_rms", "degrees", "relative")
    )
    right, wrong = (sum(getattr(f, key) for f in findings) for key in ("best_is_right", "wrong"))
    print(
        f"{name:20}{len(findings):6}{len(found):10}{right:13}{wrong:7}"
        f"{rms:10.2f}{angle:9.2f}{shift:9.2%}{searched:9}{accepted:10}"
    )
