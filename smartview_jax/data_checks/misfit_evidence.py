"""Say how likely an explanation of a misfit of robot and camera is, by Schwarz's criterion.

Errors of translation and rotation are Gaussian with variances that are estimated from the views.
The errors of a real arm are alike in views near each other, so that n views count as
n (1 - r) / (1 + r), with the correlation r of the errors that remain in successive views. They
count without those that determine the numbers, as in a restricted likelihood: a few views always
leave less with more numbers. The unit of information of Schwarz's criterion is a view.

The tilt of a small flat target errs far more than its other coordinates, and moves it as well: six
numbers of a view then tell little more than one. Therefore an explanation has to be likely twice:
if errors are alike in all directions, and if they have a covariance, estimated as well.

References:
    Schwarz, Estimating the dimension of a model, Annals of Statistics 6, 1978.
    Bayley and Hammersley, The "effective" number of independent observations in an autocorrelated
        time series, Journal of the Royal Statistical Society 8, 1946.
"""

import numpy as np
from jaxtyping import Float

from ..geometry import host_logarithms
from .closure import Poses

STRONG_EVIDENCE, VERY_STRONG_EVIDENCE = 20.0, 150.0
"""Odds, in the words of Kass and Raftery, Bayes factors, 1995."""

MIN_VARIANCE = 1e-18
"""Smallest variance of an error, m^2 and rad^2: a nanometre, for rendered views without any."""


def errors_of(closure: Poses) -> Float[np.ndarray, "*batch views 2 3"]:
    """Return the closure errors of the views, of translation (m) and rotation (rad)."""
    return in_parts(host_logarithms(closure))


def error_variances(errors: Float[np.ndarray, "views kinds 3"]) -> Float[np.ndarray, "kinds"]:
    """Return the variances of the views' errors, of translation (m^2) and rotation (rad^2)."""
    return np.maximum(np.mean(errors**2, axis=(0, 2)), MIN_VARIANCE)


def evidence(
    given: Float[np.ndarray, "views kinds 3"],
    errors: Float[np.ndarray, "views kinds 3"],
    parameters: int,
) -> float:
    """Return Schwarz's criterion of the poses as given minus with an explanation.

    It is twice the logarithm of the odds of the explanation.

    Args:
        given: errors as given, of translation (m) and rotation (rad), or of one of them alone.
        errors: what the explanation leaves over of them.
        parameters: how many numbers the explanation has.
    """
    variances, count = error_variances(errors), len(errors)
    numbers = errors[0].size
    scaled, given_scaled = (
        (part / np.sqrt(variances)[:, None]).reshape(count, numbers) for part in (errors, given)
    )
    correlation = float(np.sum(scaled[1:] * scaled[:-1])) / (numbers * (count - 1))
    correlation = min(max(correlation, 0.0), 1.0)
    independent = (1.0 - correlation) / (1.0 + correlation)
    # Both transforms, of six numbers for each kind of error, were fitted as well.
    determining = (6 * errors.shape[1] + parameters) / numbers
    effective = max((count - determining) * independent, 0.0)
    # -2 log L = 3 n log variance, for translation and rotation, or n log det covariance.
    alike = 3.0 * float(np.sum(np.log(error_variances(given) / variances)))
    by_direction = _log_determinant(given_scaled) - _log_determinant(scaled)
    penalty = parameters * np.log(max(count * independent, 1.0))
    return float(effective * min(alike, by_direction) - penalty)


def _log_determinant(scaled: Float[np.ndarray, "views numbers"]) -> float:
    """Return the logarithm of the determinant of the covariance of errors, in their usual size.

    As many views as there are numbers are added that err alike in all directions, because a
    covariance that is estimated from few views has directions without any error, by chance.
    """
    count, numbers = scaled.shape
    moments = scaled.T @ scaled + numbers * np.eye(numbers)
    return float(np.linalg.slogdet(moments / (count + numbers))[1])


def in_parts(twists: Float[np.ndarray, "*views 6"]) -> Float[np.ndarray, "*views 2 3"]:
    """Return twists by translation (m) and rotation (rad)."""
    return twists.reshape(*twists.shape[:-1], 2, 3)
