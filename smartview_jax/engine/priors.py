"""Define Gaussian priors on single parameters."""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class Prior:
    """A Gaussian prior on all parameters that a path selects; both numbers are given by name.

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
    """

    std: float
    mean: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.std < float("inf"):
            raise ValueError(f"Prior.std: expected a positive number, found {self.std}")
