"""State the limits of the search for poses without an initial one."""

import dataclasses

from ...features import EllipseOptions


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
"""The default options for parts without corners."""


@dataclasses.dataclass(frozen=True)
class SearchOptions:
    """The limits of the search for poses without an initial one; larger numbers take longer.

    Attributes:
        hypotheses: largest number of hypotheses of each model; as many are refined on the edges at
            a time.
        paths_alone: largest number of paths of corners of a single picture.
        paths: the same of each of two pictures; of more, all together have as many.
        widened: number of the best proposals of a single picture near which distant junctions are
            searched.
        workspace_slack: distance by which a proposal may leave the workspace, m: proposals are
            wrong by some mm.
        coarse_samples: samples of the wireframe for the first scores.
        coarse_gate: distance from an edge at which these scores end, px; proposals are some px off.
        fine_gate: the same for polished poses in several pictures, px.
        fine_gate_alone: the same in a single picture, which allows more wrong poses, whose edges
            all lie within some px of others, but not within one.
        compared: number of the best proposals that are compared with one another, to remove near
            duplicates: a distinct object is proposed a hundred times.
        finer_scored: number of distinct proposals that are scored again with all samples.
        polished: number of proposals that are polished.
        chance_support: share of a wireframe that other edges support by chance, which is subtracted
            from its score.
        round_parts: limits for parts without corners.
    """

    hypotheses: int = 24
    paths_alone: int = 300
    paths: int = 40
    widened: int = 32
    workspace_slack: float = 5e-3
    coarse_samples: int = 24
    coarse_gate: float = 8.0
    fine_gate: float = 4.0
    fine_gate_alone: float = 2.0
    compared: int = 1024
    finer_scored: int = 192
    polished: int = 64
    chance_support: float = 0.3
    round_parts: RoundOptions = DEFAULT_ROUND_OPTIONS

    @property
    def all_hypotheses(self) -> int:
        """The number of all polished poses: from corners and distant junctions, by two gates."""
        return 4 * self.polished


DEFAULT_SEARCH_OPTIONS = SearchOptions()
"""The default options."""
