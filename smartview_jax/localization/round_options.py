"""Hold the options of the search for round and smooth parts."""

import dataclasses

from ..features import EllipseOptions


@dataclasses.dataclass(frozen=True)
class RoundOptions:
    """The limits of the search for parts without corners, by ellipses of rims or outlines.

    Attributes:
        ellipses: which ellipses are looked for in the pictures.
        max_ellipses: largest number of ellipses of a picture, those with the most edge points.
        roundness: largest distance of a rim's vertices from a circle, over its radius.
        samples: number of samples of the rims, or of the outline, for the scores.
        gate: distance from an edge at which it is none, px.
        min_alignment: smallest cosine between an edge point's gradient and the rim's normal.
        viewpoints: number of directions from which the hull of a smooth part is matched with
            ellipses; 512 are 9 degrees apart.
        ratio_tolerance: largest difference of two ratios of axes that match: the ratio changes by
            as much from one direction to the next.
        round_ratio: ratio of axes above which their directions are uncertain.
        round_turns: number of turns in the picture that are tried then.
        per_ellipse: largest number of distinct poses of a smooth part that are proposed at an
            ellipse.
    """

    ellipses: EllipseOptions = dataclasses.field(default_factory=EllipseOptions)
    max_ellipses: int = 24
    roundness: float = 0.02
    samples: int = 64
    gate: float = 6.0
    min_alignment: float = 0.9
    viewpoints: int = 512
    ratio_tolerance: float = 0.06
    round_ratio: float = 0.9
    round_turns: int = 8
    per_ellipse: int = 64


DEFAULT_ROUND_OPTIONS = RoundOptions()
"""The default options."""
