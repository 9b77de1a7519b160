"""State the limits by which a pose is accepted, rejected or left open."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class VerdictOptions:
    """The limits by which a pose is accepted, rejected or left open.

    The defaults suit sharp pictures of solids with straight edges (benchmarks/README.md says how
    often they decide rightly). On pictures of another kind, print the `evidence` of poses that you
    know to be right or wrong, and set the limits between them.

    Attributes:
        rejected_share: explained share below which a pose is rejected.
        accepted_share: explained share above which a pose may be accepted that does not fit so
            exactly that clutter can be excluded: the outline of another object, or print on it, may
            match most edges.
        hidden_share: explained share above which a pose may be accepted if its other edges are
            occluded. Clutter must then be excluded, and the model needs faces, so that other
            dimensions can be tested.
        certain_edge_rms: largest RMS distance of the measured edges from the model, px, for which
            clutter can be excluded.
        certain_log_exactness: largest decimal logarithm of the chance of so exact a fit for which
            clutter can be excluded.
        complete_share: explained share above which nothing needs to be occluded, and moved faces
            are not tested.
        max_log_moved: largest log-likelihood ratio of the solid with a moved face to the model.
            ln(100) for each of the thousand or more solids that are tried.
        accepted_view_share: smallest explained share in each counted view.
        min_good_views: number of views that must show the object with at least that share; all, if
            there are fewer. In a further view the object may be occluded.
        min_edges: smallest number of measured edges, all views together, of a pose that is not
            rejected. Five edges have ten numbers, four more than a pose.
        min_in_picture: smallest share of the vertices within the picture, in at least one view.
        min_in_front: smallest share of the edges that no other object occludes.
        max_log_false_alarms: largest decimal logarithm of the expected number of false alarms.
        max_edge_rms: largest RMS distance of the measured edges from the model, px, beyond the
            tolerance of the model.
        alone_edge_rms: the same for an object shown from one direction only, where scale and tilt
            are free, so that objects of other sizes fit nearly as well.
        max_relative_std: largest standard deviation of a vertex, over the object's extent.
        min_margin: smallest log-likelihood ratio to the best rival, including exactness: ln(100)
            for each of some thirty poses that are examined. A pose that is less likely than a
            shadow by as much is rejected.
        min_agreement: smallest posterior probability of camera poses that are as exact as stated.
        tolerated_arms: share of arms whose poses are off by less than the tolerated disagreement of
            the views (`RobotPrior`); it is included in the covariance of the pose.

        found_probability: probability that a piece of a truly visible edge has an edge point; the
            rest is lost to shadows and to equal brightness on both sides. Pieces are as long as
            one independent observation, `INDEPENDENT_LENGTH`.
        chance_probability: probability that clutter has an edge point where a piece of an edge is
            expected.

    Raises:
        ValueError: a limit that is not a finite number, or probabilities that are not in order
            between 0 and 1; they are named.

    For example:

        >>> strict = sv.localization.VerdictOptions(accepted_share=0.95, max_relative_std=0.01)
        >>> strict.min_margin
        8.0
    """

    rejected_share: float = 0.4
    accepted_share: float = 0.88
    hidden_share: float = 0.5
    certain_edge_rms: float = 0.5
    certain_log_exactness: float = -9.0
    complete_share: float = 0.9
    max_log_moved: float = 12.0
    accepted_view_share: float = 0.45
    min_good_views: int = 2
    min_edges: int = 5
    min_in_picture: float = 0.7
    min_in_front: float = 0.3
    max_log_false_alarms: float = -2.0
    max_edge_rms: float = 1.2
    alone_edge_rms: float = 0.53
    max_relative_std: float = 0.04
    min_margin: float = 8.0
    min_agreement: float = 1e-3
    tolerated_arms: float = 0.9
    found_probability: float = 0.9
    chance_probability: float = 0.2

    def __post_init__(self) -> None:
        """Refuse limits that are not numbers: a comparison with NaN would accept any pose."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not np.isfinite(value):
                raise ValueError(f"{field.name}: expected a finite number, found {value}")
        if not 0.0 < self.chance_probability < self.found_probability < 1.0:
            raise ValueError(
                "chance_probability, found_probability: expected to grow between 0 and 1, found "
                f"{self.chance_probability} and {self.found_probability}"
            )


DEFAULT_OPTIONS = VerdictOptions()
"""The limits that are used where none are given."""
