"""Test whether the lens has distortion that its model does not describe.

Radial terms of higher order than in most lens models are added to the linearised fit, in pixels RMS
over the points; camera, poses and target adapt to them. If the model is right, the terms are zero;
otherwise they have a normal prior about zero whose standard deviation is between a hardly
measurable error and a gross one. The covariance of the transforms is widened by the change that the
terms would make, weighted by the probability that they are needed. Given the transforms, all other
parameters keep their distribution without the terms, so that the predicted pixels of the
calibration, which has no terms, are as certain as before.
"""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from ..dataset import view_residuals
from ..engine import FittedChain, Step
from ..runtime.modules import with_fields
from .likelihood import marginalise
from .linearised_views import LinearisedViews
from .standard_deviations import StandardDeviations
from .view_statistics import ViewStatistics

STANDARD_DEVIATIONS = np.geomspace(0.01, 10.0, 16)
"""Equally probable standard deviations of the terms, px RMS over the points: from below the
detection noise to above the misfit of any lens model."""

SAME_FUNCTION = 1e-6
"""Fraction of a term's information that remains after all other parameters have adapted, below
which the term is taken as part of the lens model."""

RADIAL_POWERS = (2, 3, 4)
"""Powers of the squared distance from the picture's centre by which the radial terms grow.

Decentring is left out: a rotation of the camera compensates for it almost completely, and makers of
lenses keep it small.
"""


class LensEvidence(NamedTuple):
    """The evidence for distortion that the lens model does not describe.

    Attributes:
        probability: probability that there is such distortion.
        rms: RMS misfit over the points, px, after all other parameters have adapted.
        covariance: covariance of the shared parameters to add to a fit without the terms.
    """

    probability: float
    rms: float
    covariance: Float[np.ndarray, "shared shared"]


def lens_evidence(
    views: ViewStatistics,
    z: Step,
    linearised: LinearisedViews,
    sigmas: StandardDeviations,
    chain: FittedChain,
    names: Sequence[str],
    wrong_lens_probability: float,
) -> LensEvidence | None:
    """Return the evidence on the lens; None if all points are at the picture's centre.

    Args:
        views: statistics of the views.
        z: step at the linearisation.
        linearised: the views linearised there.
        sigmas: standard deviations of all errors.
        chain: the chain of transforms there.
        names: names of the shared parameters.
        wrong_lens_probability: prior probability that the terms are needed.
    """
    terms = _terms(views, chain) if wrong_lens_probability else None
    if terms is None:
        return None
    extended = _with_terms(views, z, linearised, terms)
    marginal = marginalise(extended, sigmas)
    count = len(terms)
    covariance, step = np.asarray(marginal.shared_covariance), np.asarray(marginal.step.shared)
    if not (np.isfinite(covariance).all() and np.isfinite(step).all()):
        return None
    of_terms = covariance[-count:, -count:]
    by_terms = covariance[:-count, -count:] @ np.linalg.inv(of_terms)
    # Without the widest prior: information matrix S and its product with the best step, S e = h.
    precision = np.linalg.inv(of_terms)
    information = precision - np.eye(count) / STANDARD_DEVIATIONS[-1] ** 2
    values, axes = np.linalg.eigh(0.5 * (information + information.T))
    visible_count = int(np.asarray(views.one_camera.observations.visible).sum())
    new = values > SAME_FUNCTION * visible_count / float(sigmas.pixel) ** 2
    if not new.any():
        return None
    values, axes = values[new], axes[:, new]
    pull = axes.T @ (precision @ step[-count:])
    # With a prior of standard deviation t, the Bayes factor against no terms at all is
    #     2 log B = h^T (S + t^-2)^-1 h - log det(1 + t^2 S).
    variances = STANDARD_DEVIATIONS[:, None] ** 2
    posterior = variances / (1.0 + variances * values)
    log_factors = 0.5 * (posterior * pull**2 - np.log1p(variances * values)).sum(axis=1)
    log_odds = logsumexp(log_factors) - np.log(len(log_factors))
    log_odds += np.log(wrong_lens_probability) - np.log1p(-wrong_lens_probability)
    probability = float(1.0 / (1.0 + np.exp(-log_odds)))
    weights = np.exp(log_factors - logsumexp(log_factors))
    means = posterior * pull
    explained = weights @ (means * pull).sum(axis=1) * float(sigmas.pixel) ** 2
    # The second moment of the coefficients of the terms, about zero.
    moment = np.einsum("t,ti,tj->ij", weights, means, means) + np.diag(weights @ posterior)
    without_terms = covariance[:-count, :-count] - by_terms @ covariance[-count:, :-count]
    prefixes = tuple(f"{name}." for name in chain.calibration.transform_names)
    transforms = [k for k, name in enumerate(names) if name.startswith(prefixes)]
    changes = _with_transforms(without_terms, transforms, (by_terms @ axes)[transforms])
    return LensEvidence(
        probability,
        float(np.sqrt(max(explained, 0.0) / max(visible_count, 1))),
        probability * (changes @ moment @ changes.T),
    )


def _with_transforms(
    covariance: Float[np.ndarray, "shared shared"],
    transforms: Sequence[int],
    changes: Float[np.ndarray, "transforms changes"],
) -> Float[np.ndarray, "shared changes"]:
    """Return the changes of all parameters that go with changes of the transforms' parameters.

    Args:
        covariance: covariance of the shared parameters.
        transforms: indices of the transforms' parameters.
        changes: changes of the transforms' parameters.
    """
    # E(x | t) = C_xt C_tt^-1 t, with t in units of its standard deviations (metres and radians).
    columns = covariance[:, transforms]
    scale = np.sqrt(np.diagonal(columns[transforms]))
    correlation = columns[transforms] / np.outer(scale, scale)
    by_transforms = (columns / scale) @ np.linalg.pinv(correlation, hermitian=True)
    return by_transforms @ (changes / scale[:, None])


def _terms(
    views: ViewStatistics, chain: FittedChain
) -> Float[np.ndarray, "terms views points 2"] | None:
    """Return the pixel displacements by each term, 1 px RMS over the points, mutually orthogonal.

    None if too few points are away from the picture's centre, or a point cannot be projected.
    """
    observations, camera = views.one_camera.observations, chain.calibration.camera
    visible = np.asarray(observations.visible)[..., None]
    residuals = view_residuals(
        camera, chain.calibration.target_scale, chain.camera_from_world, observations
    )
    # At predicted pixels, because functions of measured pixels are correlated with their noise.
    predicted = np.asarray(observations.pixels) - np.asarray(residuals)
    centre = np.array([float(camera.u0), float(camera.v0)])
    away = np.where(visible, predicted - centre, 0.0)
    farthest = float(np.sqrt((away**2).sum(axis=-1).max(initial=0.0)))
    if not 0.0 < farthest < np.inf:
        return None
    place = away / farthest
    square = (place**2).sum(axis=-1, keepdims=True)
    terms = np.stack([place * square**power for power in RADIAL_POWERS])
    # Orthogonalised, so that the terms are independent.
    flat, triangle = np.linalg.qr(terms.reshape(len(terms), -1).T)
    if not (np.abs(np.diagonal(triangle)) > 1e-9 * np.abs(triangle).max()).all():
        return None
    return np.sqrt(visible.sum()) * flat.T.reshape(terms.shape)


def _with_terms(
    views: ViewStatistics,
    z: Step,
    linearised: LinearisedViews,
    terms: Float[np.ndarray, "terms views points 2"],
) -> LinearisedViews:
    """Return the linearised views with the terms as shared parameters after all others."""
    # If the pixels move by a term b, the gradient -J^T r becomes -J^T (r + b), and half the sum of
    # squares |r|^2 / 2 grows by b^T r + |b|^2 / 2: so the compiled linearisation gives the products
    # of the terms with all other parameters.
    products = np.einsum("ivpk,jvpk->ij", terms, terms)
    by_shared, by_view, by_residual = [], [], []
    for term, square in zip(terms, np.diagonal(products), strict=True):
        moved = _with_moved_pixels(views, term).linearise(z)
        by_shared.append(linearised.gradient.shared - moved.gradient.shared)
        by_view.append(linearised.gradient.per_view - moved.gradient.per_view)
        growth = moved.residual_sum_of_squares - linearised.residual_sum_of_squares
        by_residual.append(0.5 * (float(growth) - square))
    border = np.stack(by_shared, axis=1)
    matrix, gradient, offset = linearised.matrix, linearised.gradient, linearised.offset_from_prior
    count = len(terms)
    return linearised._replace(
        matrix=with_fields(
            matrix,
            shared=np.block([[np.asarray(matrix.shared), border], [border.T, products]]),
            border=np.concatenate([matrix.border, np.stack(by_view, axis=-1)], axis=-1),
        ),
        gradient=gradient._replace(shared=np.append(gradient.shared, -np.array(by_residual))),
        offset_from_prior=offset._replace(shared=np.append(offset.shared, np.zeros(count))),
        known_weight=np.append(
            linearised.known_weight, np.full(count, 1.0 / STANDARD_DEVIATIONS[-1])
        ),
        group_index=np.append(linearised.group_index, np.full(count, -1)),
    )


def _with_moved_pixels(
    views: ViewStatistics, change: Float[np.ndarray, "views points 2"]
) -> ViewStatistics:
    """Return the statistics with other pixels."""
    moved = copy.copy(views)
    problem = views.one_camera
    observations = problem.seen_points
    pixels = np.asarray(observations.pixels) + change
    moved.problem = with_fields(problem, observations=with_fields(observations, pixels=pixels))
    return moved
