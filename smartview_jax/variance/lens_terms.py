"""Ask of the pictures whether the lens bends in a way that its model does not know.

Radial terms of higher order than most lens models have are added to the linearised fit, in pixels
RMS over the points. Whatever camera, poses
and target can make up for is left to them. A lens that the model describes needs none of the terms;
otherwise they have a normal prior about zero whose standard deviation may be anything between a
hardly measurable error and a gross one. The more probable it is that the terms are needed, the more
the covariance of the transforms covers what they would change. Given the transforms, all other
parameters have the distribution that they have without the terms, so that the calibration, which
has none, predicts pixels as surely as before.
"""

import copy
import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from ..dataset import view_residuals
from ..engine import FittedChain, Step
from ..runtime.array_namespace import to_device
from .likelihood import LinearisedViews, StandardDeviations, marginalise
from .view_statistics import ViewStatistics

STANDARD_DEVIATIONS = np.geomspace(0.01, 10.0, 16)
"""Equally probable standard deviations of the terms, px RMS over the points: from what detection
blurs to what no model of a lens leaves."""

SAME_FUNCTION = 1e-6
"""Part of a term's information that other parameters leave, below which they can make the same
pictures: the term is then one of the lens model's own."""

RADIAL_POWERS = (2, 3, 4)
"""Powers of the squared distance from the picture's centre by which the radial terms grow.

Decentring is left out: a turn of the camera makes up for it so well that pictures do not tell, and
the makers of lenses see to it.
"""


class LensEvidence(NamedTuple):
    """The evidence of the pictures that the lens bends otherwise than its model describes.

    Attributes:
        probability: probability that it does.
        rms: RMS misfit over the points, px, that is left after all other parameters have adapted.
        covariance: covariance of the shared parameters that a fit without the terms lacks.
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
    """Return the evidence on the lens; None where no point is away from the picture's centre.

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
    own = covariance[-count:, -count:]
    by_terms = covariance[:-count, -count:] @ np.linalg.inv(own)
    # Without the widest prior: information matrix S and its product with the best step, S e = h.
    precision = np.linalg.inv(own)
    information = precision - np.eye(count) / STANDARD_DEVIATIONS[-1] ** 2
    values, axes = np.linalg.eigh(0.5 * (information + information.T))
    seen = int(np.asarray(views.problem.observations.visible).sum())
    new = values > SAME_FUNCTION * seen / float(sigmas.pixel) ** 2
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
        float(np.sqrt(max(explained, 0.0) / max(seen, 1))),
        probability * (changes @ moment @ changes.T),
    )


def _with_transforms(
    covariance: Float[np.ndarray, "shared shared"],
    transforms: Sequence[int],
    changes: Float[np.ndarray, "transforms changes"],
) -> Float[np.ndarray, "shared changes"]:
    """Return changes of the transforms' parameters with what they entail for all others.

    Args:
        covariance: covariance of the shared parameters.
        transforms: indices of the transforms' parameters.
        changes: changes of the transforms' parameters.
    """
    # E(x | t) = C_xt C_tt^-1 t, with t in its standard deviations: metres and radians differ.
    columns = covariance[:, transforms]
    scale = np.sqrt(np.diagonal(columns[transforms]))
    correlation = columns[transforms] / np.outer(scale, scale)
    by_transforms = (columns / scale) @ np.linalg.pinv(correlation, hermitian=True)
    return by_transforms @ (changes / scale[:, None])


def _terms(
    views: ViewStatistics, chain: FittedChain
) -> Float[np.ndarray, "terms views points 2"] | None:
    """Return how each term moves the predicted pixels, by one pixel RMS; each without the last.

    None where too few points are away from the picture's centre, or one cannot be projected.
    """
    observations, camera = views.problem.observations, chain.calibration.camera
    visible = np.asarray(observations.visible)[..., None]
    residuals = view_residuals(
        camera, chain.calibration.target_scale, chain.camera_from_world, observations
    )
    # Functions of measured pixels would go together with these pixels' noise.
    predicted = np.asarray(observations.pixels) - np.asarray(residuals)
    centre = np.array([float(camera.u0), float(camera.v0)])
    away = np.where(visible, predicted - centre, 0.0)
    farthest = float(np.sqrt((away**2).sum(axis=-1).max(initial=0.0)))
    if not 0.0 < farthest < np.inf:
        return None
    place = away / farthest
    square = (place**2).sum(axis=-1, keepdims=True)
    terms = np.stack([place * square**power for power in RADIAL_POWERS])
    # Each without what the terms before it can do, so that all of them are independent.
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
    # Where the pixels move by a term b, the gradient -J^T r becomes -J^T (r + b), and half the sum
    # of squares |r|^2 / 2 grows by b^T r + |b|^2 / 2: the compiled program of the linearisation
    # tells how the terms go together with all other parameters.
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
    return dataclasses.replace(
        linearised,
        matrix=eqx.tree_at(
            lambda m: (m.shared, m.border),
            matrix,
            (
                np.block([[np.asarray(matrix.shared), border], [border.T, products]]),
                np.concatenate([matrix.border, np.stack(by_view, axis=-1)], axis=-1),
            ),
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
    pixels = to_device(np.asarray(views.problem.observations.pixels) + change)
    moved.problem = eqx.tree_at(lambda p: p.observations.pixels, views.problem, pixels)
    return moved
