"""Fit the ratio of a camera's focal lengths, `camera.pixel_aspect`, in the place of alpha_v.

Pixels of a sensor are square to one part in a thousand or better, which tells the ratio
`alpha_v / alpha_u`, but neither focal length. In a fit with such a prior the camera's second number
is the ratio, so that the prior is on a single parameter, as all others. Parameters keep their
names, and covariances are stated for alpha_u and alpha_v: they are converted where a fit ends.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..runtime.array_namespace import AnyArray, array_namespace

PIXEL_ASPECT = "camera.pixel_aspect"
"""The name of the ratio of the focal lengths, alpha_v / alpha_u."""

_ALPHA_V = "camera.alpha_v"

_U, _V = 0, 1
"""Places of alpha_u, and of alpha_v or the ratio, among the numbers of a camera."""


def is_aspect(path: str) -> bool:
    """Return whether a path names the ratio of focal lengths; of a rig, after the camera's name."""
    return f".{path}".endswith(f".{PIXEL_ASPECT}")


def alpha_v_of(path: str) -> str:
    """Return the name of the alpha_v in whose place a ratio is fitted; other paths as they are."""
    return path.removesuffix(PIXEL_ASPECT) + _ALPHA_V if is_aspect(path) else path


def refuse_aspects(paths: Iterable[str]) -> None:
    """Raise a ValueError if a path names a ratio of focal lengths, where only priors may."""
    for path in filter(is_aspect, paths):
        raise ValueError(f"{path!r} is a path of priors only; expected {alpha_v_of(path)!r} here")


def is_alpha_v(name: str) -> bool:
    """Return whether a parameter is a camera's alpha_v."""
    return f".{name}".endswith(f".{_ALPHA_V}")


def alpha_u_of(name: str) -> str:
    """Return the name of the alpha_u of the camera of an alpha_v."""
    return f"{name.removesuffix('_v')}_u"


def aspect_of(name: str) -> str:
    """Return the name of the ratio that is fitted in the place of an alpha_v."""
    return name.removesuffix(_ALPHA_V) + PIXEL_ASPECT


def with_aspect(
    numbers: Float[Any, "numbers"], fits_aspect: Bool[AnyArray, ""]
) -> Float[Any, "numbers"]:
    """Return the numbers of a camera with the ratio in the place of alpha_v, where it is fitted."""
    xp = array_namespace(numbers)
    second = xp.where(fits_aspect, numbers[_V] / numbers[_U], numbers[_V])
    return xp.concatenate([numbers[:_V], second[None], numbers[_V + 1 :]])


def without_aspect(
    numbers: Float[Any, "numbers"], fits_aspect: Bool[AnyArray, ""]
) -> Float[Any, "numbers"]:
    """Return the numbers of a camera with alpha_v in the place of a ratio that is fitted."""
    xp = array_namespace(numbers)
    second = xp.where(fits_aspect, numbers[_V] * numbers[_U], numbers[_V])
    return xp.concatenate([numbers[:_V], second[None], numbers[_V + 1 :]])


class FittedAspects(NamedTuple):
    """The cameras of a problem, and which of them have their ratio fitted.

    Attributes:
        places: indices of each camera's alpha_u, and of its alpha_v or ratio, among the shared
            parameters.
        fits_aspect: whether the ratio of each camera is fitted.
    """

    places: Int[AnyArray, "cameras 2"]
    fits_aspect: Bool[AnyArray, "cameras"]

    def named_by_fitted(self, values: Float[Any, "shared"]) -> Float[Any, "shared shared"]:
        """Return the derivative of the parameters with alpha_v by those with the ratio.

        Args:
            values: values of the parameters of the fit.
        """
        # d alpha_v = a d alpha_u + alpha_u d a
        xp = array_namespace(values)
        index = xp.arange(len(values))
        at_u, at_v = (
            (xp.asarray(self.places)[:, k, None] == index[None]).astype(float) for k in (_U, _V)
        )
        alpha_u, aspect = ((at @ values)[:, None] for at in (at_u, at_v))
        fits = xp.asarray(self.fits_aspect)[:, None]
        change = xp.where(fits, aspect * at_u + (alpha_u - 1.0) * at_v, 0.0)
        return xp.eye(len(values)) + at_v.T @ change

    def fitted_names(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return names of all shared parameters, each ratio that is fitted in place of alpha_v."""
        ratios = np.asarray(self.places)[np.asarray(self.fits_aspect), _V].tolist()
        return tuple(aspect_of(name) if k in ratios else name for k, name in enumerate(names))


def joined_aspects(parts: Sequence[FittedAspects]) -> FittedAspects | None:
    """Return the cameras of several parts of a problem together; None if no ratio is fitted."""
    if not any(np.asarray(part.fits_aspect).any() for part in parts):
        return None
    return FittedAspects(
        *(np.concatenate([np.asarray(x) for x in field]) for field in zip(*parts, strict=True))
    )
