"""Find the clicks that explain why known facts contradict the pictures.

One wrong click is enough to make a right fact seem wrong. So each click is left out in turn: if the
others then agree with all facts, that click may be the wrong one.
"""

from collections.abc import Sequence
from typing import NamedTuple, Unpack

import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import null_space
from scipy.special import chdtrc

from ...robots import CommandLike
from ..calibration_uncertainty import CalibrationUncertainty, UncertaintyOptions
from ..correspondence_checks import deletion_of, least_chi_square_matrix
from ..line_jacobians import Lines
from ..pixel_jacobians import pixel_jacobians
from ..rig_views import AnyCalibration
from ..triangulation import CLICK_SIGMA
from ..view_poses import SeenViews, whitening_of
from .constraint_geometry import VARIABLE_SIZES, Shape
from .constraints import AbstractConstraint

AGREEMENT_PROBABILITY = 0.01
"""Probability that the right clicks are said to disagree when the wrong one is left out."""


class SuspectClick(NamedTuple):
    """A click without which the other clicks agree with the facts.

    Attributes:
        view: index of the view.
        point: index of the point.
        chi_square: squared residuals that remain without the click, over their covariance.
        degrees_of_freedom: their degrees of freedom.
    """

    view: int
    point: int
    chi_square: float
    degrees_of_freedom: int


def suspect_clicks(
    calibration: AnyCalibration,
    poses: CommandLike | None,
    pixels: Float[np.ndarray, "views points 2"] | Float[Array, "views points 2"],
    points: Float[np.ndarray, "points 3"],
    constraints: Sequence[AbstractConstraint],
    *,
    pixel_sigma: float | np.ndarray = CLICK_SIGMA,
    agreement: float = AGREEMENT_PROBABILITY,
    **uncertainty: Unpack[UncertaintyOptions],
) -> list[SuspectClick]:
    """Return each click that, left out alone, makes the other clicks agree, the likeliest first.

    Of several clicks any one may be wrong; if none is returned, no single click explains the
    contradiction. All is to first order about the refined points.

    Reference: Cook and Weisberg, Residuals and influence in regression, 1982, section 2.2.

    Args:
        calibration, poses, pixel_sigma: as in `triangulate_points`.
        pixels: the clicks, px; NaN where a point was not clicked.
        points: the points that `refine` found under the constraints, m.
        constraints: facts about vertices only, which hold together.
        agreement: smallest p-value at which the rest agrees.
        uncertainty: `covariance` and `noise`, as in `triangulate_points`.

    Raises:
        ValueError: as in `triangulate_points`.
    """
    views = SeenViews.of(calibration, poses)
    measured, visible = views.checked_points(pixels, None)
    known = CalibrationUncertainty.of(views, calibration, **uncertainty)
    whitening = np.broadcast_to(whitening_of(pixel_sigma, visible.shape), (*visible.shape, 2, 2))
    jacobians = pixel_jacobians(views, points)
    facts = _linearised(constraints, points)
    # Rows are the coordinates of all clicks and then the uncertain facts, in units of their
    # standard deviations; the unknowns are the steps that keep the exact facts.
    clicks = np.argwhere(visible)
    L = whitening[visible]
    residual = np.einsum("kij,kj->ki", L, (measured - jacobians.pixels)[visible])
    by_step = np.zeros((len(clicks), 2, facts.free.shape[0]))
    for row, (view, point) in enumerate(clicks):
        by_step[row, :, 3 * point : 3 * point + 3] = L[row] @ jacobians.by_point[view, point]
    r = np.concatenate([residual.ravel(), -facts.soft_values])
    J = np.concatenate([by_step.reshape(2 * len(clicks), -1), facts.soft]) @ facts.free
    sensitivity = np.einsum(
        "kij,kjl,kln->kin",
        L, jacobians.by_view[visible], known.view_jacobian[clicks[:, 0]],
    ).reshape(2 * len(clicks), -1)  # fmt: skip
    R = np.eye(len(r))
    R[: len(sensitivity), : len(sensitivity)] += sensitivity @ known.covariance @ sensitivity.T
    Q = least_chi_square_matrix(R, J)
    freedom = len(r) - int(np.linalg.matrix_rank(J))
    suspects = []
    for row, (view, point) in enumerate(clicks):
        _, deleted, rest = deletion_of(Q, r, row)
        remaining = freedom - deleted
        if deleted and (remaining <= 0 or chdtrc(remaining, rest) >= agreement):
            suspects.append(SuspectClick(int(view), int(point), rest, remaining))
    return sorted(suspects, key=lambda click: click.chi_square)


class _Facts(NamedTuple):
    """Facts, linear in the steps of the points and of the facts' own planes.

    Attributes:
        free: a basis of the steps that keep all exact facts.
        soft: derivatives of the uncertain facts by the steps, over their standard deviations.
        soft_values: their values over their standard deviations.
    """

    free: Float[np.ndarray, "steps free"]
    soft: Float[np.ndarray, "facts steps"]
    soft_values: Float[np.ndarray, "facts"]


def _linearised(
    constraints: Sequence[AbstractConstraint], points: Float[np.ndarray, "points 3"]
) -> _Facts:
    """Return the facts about points, each with its unknown plane at the best place."""
    planes = [constraint.initial_plane(points) for constraint in constraints]
    steps = 3 * len(points) + 3 * sum(plane is not None for plane in planes)
    exact, soft, soft_values = [np.zeros((0, steps))], [np.zeros((0, steps))], [np.zeros(0)]
    first = 3 * len(points)
    for constraint, plane in zip(constraints, planes, strict=True):
        centre, normal = (np.zeros(3), np.array([0.0, 0.0, 1.0])) if plane is None else plane
        lines = Lines(np.zeros((0, 3)), np.zeros((0, 3)))
        shape = Shape(points, lines, normal[None], np.zeros(1), centre[None])
        fact = constraint.evaluate(shape, -1 if plane is None else 0)
        rows = np.zeros((len(fact.values), steps))
        for (kind, k), part in fact.jacobians.items():
            start = first if kind == "plane" else 3 * k
            rows[:, start : start + VARIABLE_SIZES[kind]] = part
        first += 0 if plane is None else 3
        if constraint.sigma is None:
            exact.append(rows)
        else:
            soft.append(rows / constraint.sigma)
            soft_values.append(fact.values / constraint.sigma)
    return _Facts(null_space(np.concatenate(exact)), *map(np.concatenate, (soft, soft_values)))
