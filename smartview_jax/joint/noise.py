"""How large the errors of pixels and of reported robot poses are taken to be."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations of what is measured.

    With a `Noise`, every view carries a correction `c_i` of its reported pose,
    `tool_from_base = exp(c_i) @ reported_i`, with a Gaussian prior of these sizes.

    Attributes:
        pixel: of u and of v, px.
        translation: of the reported position, per axis at the tool, m; infinite for none known.
        rotation: of the reported orientation, per axis at the tool, rad; infinite for none known.
    """

    pixel: float
    translation: float
    rotation: float

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if not (value > 0.0 and (name != "pixel" or value < math.inf)):
                raise ValueError(f"Noise.{name}: expected a positive number, found {value}")

    @property
    def bounds_poses(self) -> bool:
        """Whether reports hold the poses at all; if not, `pixel` is of no consequence."""
        return min(self.translation, self.rotation) < math.inf
