"""How large the errors of pixels and of reported robot poses are taken to be."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations of what is measured.

    With a `Noise`, every view carries a correction `c_i` of its reported pose,
    `tool_from_base = exp(c_i) @ reported_i`, with a Gaussian prior of these sizes.

    Attributes:
        pixel: of u and of v, px.
        translation: of the reported position, per axis at the tool, m.
        rotation: of the reported orientation, per axis at the tool, rad.
    """

    pixel: float
    translation: float
    rotation: float

    def __post_init__(self):
        for name, value in dataclasses.asdict(self).items():
            if not 0.0 < value < float("inf"):
                raise ValueError(f"Noise.{name}: expected a positive number, found {value}")
