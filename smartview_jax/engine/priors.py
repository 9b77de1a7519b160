"""Define Gaussian priors on parameters, and what a fit holds, frees and assumes."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypedDict

import numpy as np
from jaxtyping import Bool, Float, Int

from ..argument_checks import is_selected, require_instance, require_names
from .parameters import Step, host_step, parameter_mask
from .pixel_aspect import alpha_u_of, alpha_v_of, is_aspect


@dataclasses.dataclass(frozen=True, kw_only=True)
class Prior:
    """A Gaussian prior on all parameters that a path selects; both numbers are given by name.

    The path `camera.pixel_aspect` is the ratio of the focal lengths, `alpha_v / alpha_u`, which is
    one within 1e-3 or better for square pixels. With a mean of one and a standard deviation of
    1e-9 both focal lengths are the same number, as with OpenCV's CALIB_FIX_ASPECT_RATIO.

    Attributes:
        std: standard deviation, in the parameter's own unit (px, m, rad, 1).
        mean: mean value; None is the value of the start. The prior of a rotation is always centred
            at the start and has no mean.

    For example:

        >>> drawing = sv.Prior(std=2e-4)  # known to 0.2 mm, at the start's value
        >>> for priors in ({}, {"camera_from_tool.translation": drawing}):
        ...     joint = sv.fit_joint(data, truth, noise=noise, priors=priors)
        ...     print(f"{1e3 * joint.std['camera_from_tool.translation.x']:.2f} mm")
        0.57 mm
        0.19 mm
        >>> square = {"camera.pixel_aspect": sv.Prior(mean=1.0, std=1e-3)}
        >>> joint = sv.fit_joint(data, truth, noise=noise, priors=square)
        >>> print(f"+- {joint.std['camera.pixel_aspect']:.4f}")
        +- 0.0002
    """

    std: float
    mean: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.std < float("inf"):
            raise ValueError(f"Prior.std: expected a positive number, found {self.std}")


class ParameterOptions(TypedDict, total=False):
    """The fields of `ParameterChoice` as keyword arguments of fits and bounds, all optional."""

    fixed: Sequence[str]
    free: Sequence[str]
    priors: Mapping[str, Prior] | None


class ParameterChoice(NamedTuple):
    """The parameters that a fit holds, frees, and has prior knowledge of.

    Attributes:
        fixed: paths of parameters that keep the start's values.
        free: paths to free that are held by default.
        priors: priors by path.
    """

    fixed: tuple[str, ...]
    free: tuple[str, ...]
    priors: dict[str, Prior]

    @classmethod
    def of(
        cls,
        fixed: Sequence[str] = (),
        free: Sequence[str] = (),
        priors: Mapping[str, Prior] | None = None,
    ) -> "ParameterChoice":
        """Return the choice that a user made by the arguments of a fit.

        Raises:
            TypeError: a prior that is not a `Prior`.
            ValueError: a single text in place of a list of paths, or a ratio of focal lengths that
                is to be held or freed.
        """
        require_names("fixed", fixed)
        require_names("free", free)
        for path in filter(is_aspect, (*fixed, *free)):
            raise ValueError(
                f"{path!r} is neither held nor freed, but known by a prior; to hold it give "
                f"priors={{{path!r}: Prior(mean=1.0, std=1e-9)}}"
            )
        for path, prior in (priors or {}).items():
            require_instance(f"priors[{path!r}]", prior, Prior, "a Prior has a mean and a std")
        return cls(tuple(fixed), tuple(free), dict(priors or {}))

    def states(self, path: str) -> bool:
        """Return whether the user made any choice of this very path."""
        return path in (*self.fixed, *self.free, *self.priors)

    def is_free(self, names: Sequence[str], held: Iterable[str]) -> Bool[np.ndarray, "parameters"]:
        """Return which parameters are fitted.

        Args:
            names: names of all parameters.
            held: paths of parameters that are held unless the choice frees them.

        Raises:
            ValueError: a path selects nothing; the message suggests similar names.
        """
        is_free = ~parameter_mask(names, held) | parameter_mask(names, self.free)
        return is_free & ~parameter_mask(names, self.fixed)

    def with_fitted_aspects(
        self, names: Sequence[str], is_free: Bool[np.ndarray, "parameters"]
    ) -> tuple["ParameterChoice", frozenset[str]]:
        """Return the choice, and each alpha_v in whose place the ratio of focal lengths is fitted.

        The ratio is fitted where it has a prior. The choice is without the priors on ratios of
        cameras that are held.

        Args:
            names: names of all parameters.
            is_free: which of them are fitted.

        Raises:
            ValueError: a prior on a ratio which is not positive, or next to a prior on its alpha_v,
                or while alpha_v alone is held.
        """
        fitted, free = set(), dict(zip(names, is_free.tolist(), strict=True))
        for path in filter(is_aspect, self.priors):
            parameter_mask(names, (path,))
            alpha_v, mean = alpha_v_of(path), self.priors[path].mean
            others = [other for other in self.priors if other != path]
            if mean is not None and not mean > 0.0:
                raise ValueError(f"prior on {path!r}: a ratio is positive; found a mean of {mean}")
            if is_selected(alpha_v, others):
                raise ValueError(
                    f"prior on {path!r}: give one either on the ratio of the focal lengths or on "
                    f"{alpha_v!r}, and not on both"
                )
            if free[alpha_u_of(alpha_v)] and not free[alpha_v]:
                raise ValueError(
                    f"prior on {path!r}: {alpha_v!r} is held; hold {alpha_u_of(alpha_v)!r} instead"
                )
            if free[alpha_v]:
                fitted.add(alpha_v)
        priors = {
            path: prior
            for path, prior in self.priors.items()
            if not is_aspect(path) or alpha_v_of(path) in fitted
        }
        return self._replace(priors=priors), frozenset(fitted)

    def of_camera(self, name: str) -> "ParameterChoice":
        """Return the choice that concerns the lens of a rig's camera, in the camera's own names."""
        start, lens = f"{name}.", f"{name}.camera"

        def lens_paths(paths: Iterable[str]) -> tuple[str, ...]:
            """Return the paths of the lens, without the camera's name."""
            whole = (lens if path == name else path for path in paths)
            return tuple(path.removeprefix(start) for path in whole if path.startswith(lens))

        of_lens = {path: prior for path, prior in self.priors.items() if path.startswith(lens)}
        priors = {path.removeprefix(start): prior for path, prior in of_lens.items()}
        return ParameterChoice(lens_paths(self.fixed), lens_paths(self.free), priors)

    def holding(self, *paths: str) -> "ParameterChoice":
        """Return the choice with further parameters held."""
        return self._replace(fixed=(*self.fixed, *paths))

    def freeing(self, *paths: str) -> "ParameterChoice":
        """Return the choice with further parameters freed."""
        return self._replace(free=(*self.free, *paths))


class ParameterTable(NamedTuple):
    """All parameters of a least-squares problem: the shared ones, then six of each view.

    Attributes:
        names: names of the parameters.
        shared_size: number of the shared ones.
        is_free: mask of the free ones.
        mean, weight: mean and inverse standard deviation of the priors, as in `AbstractProblem`.
    """

    names: Sequence[str]
    shared_size: int
    is_free: Bool[np.ndarray, "parameters"]
    mean: Float[np.ndarray, "parameters"]
    weight: Float[np.ndarray, "parameters"]

    @property
    def shared_names(self) -> tuple[str, ...]:
        """The names of the free shared parameters."""
        return tuple(self.names[int(k)] for k in self._free_shared)

    @property
    def per_view_names(self) -> tuple[str, ...]:
        """The names of the free parameters of single views."""
        names = self.names[self.shared_size :]
        is_free = self.is_free[self.shared_size :]
        return tuple(names[k] for k in np.flatnonzero(is_free).tolist())

    def fields(self) -> dict[str, Any]:
        """Return the fields of the problem that describe its parameters, as NumPy arrays."""
        per_view_free = self.is_free[self.shared_size :].reshape(-1, 6)
        return {
            "free": self._free_shared,
            "per_view_free": per_view_free,
            "prior_mean": self._step(self.mean),
            "prior_weight": self._step(self.weight),
            "scale": host_step(np.ones(len(self._free_shared)), np.ones(per_view_free.shape)),
        }

    @property
    def _free_shared(self) -> Int[np.ndarray, "free"]:
        """The indices of the free shared parameters."""
        return np.flatnonzero(self.is_free[: self.shared_size])

    def _step(self, vector: Float[np.ndarray, "parameters"]) -> Step:
        """Split a value of each parameter into the shared ones and six of each view."""
        return host_step(vector[: self.shared_size], vector[self.shared_size :].reshape(-1, 6))
