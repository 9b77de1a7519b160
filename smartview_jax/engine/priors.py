"""What is known of a parameter before any picture is seen."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Prior:
    """A Gaussian prior on the parameters that a path names.

    Attributes:
        std: standard deviation, in the parameter's own unit (px, m, rad, 1).
        mean: its value; None takes the start's. Rotations have no mean of their own: their prior
            is about the start.
    """

    std: float
    mean: float | None = None

    def __post_init__(self):
        if not 0.0 < self.std < float("inf"):
            raise ValueError(f"Prior.std: expected a positive number, found {self.std}")
