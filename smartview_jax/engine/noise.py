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
        field: of the coefficients of the robot's error, one for each of the field's groups.
        white_pixel: of u and of v about a view's own best pose, px; None where it is `pixel`. Real
            pixels err together, so that a view tells less of the camera and of its pose than its
            many points suggest: `pixel` is what weighs them, and this what predicts them.
    """

    pixel: float
    translation: float
    rotation: float
    field: tuple[float, ...] = ()
    white_pixel: float | None = None

    def __post_init__(self):
        named = [("translation", self.translation), ("rotation", self.rotation)]
        finite = [("pixel", self.pixel), *(("field", value) for value in self.field)]
        finite += [] if self.white_pixel is None else [("white_pixel", self.white_pixel)]
        for name, value in named + finite:
            if not (value > 0.0 and ((name, value) in named or value < math.inf)):
                raise ValueError(f"Noise.{name}: expected a positive number, found {value}")

    @property
    def bounds_poses(self) -> bool:
        """Whether reports hold the poses at all; if not, the residuals tell the pixels' sigma."""
        return min(self.translation, self.rotation) < math.inf
