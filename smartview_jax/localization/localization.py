"""Hold what is known of an object that was looked for: pose, covariance, verdict and rivals."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..features import PictureEvidence
from ..modeling import ObjectModel
from ..robots import Command
from .chance import log_odds_of
from .refinement import RefinedPose
from .verdict import Verdict


def model_name(model: ObjectModel, index: int) -> str:
    """Return what a model is called in messages: its name or, without one, its index."""
    return model.name or f"model {index}"


class EdgeMatch(NamedTuple):
    """An edge of the model that was measured in a view.

    Attributes:
        view, edge: indices of the view and of the model's edge.
        distance: of the edge points from the predicted edge, at their mean, px.
        visible_px: visible length of the edge, px.
        found_px: length with edge points, px.
        consistent: whether it is where its noise lets it be; others contradict the pose, and
            hardly count.
    """

    view: int
    edge: int
    distance: float
    visible_px: float
    found_px: float
    consistent: bool


class Rival(NamedTuple):
    """Another pose, or another model, at the same place.

    Attributes:
        model: index of the model.
        world_from_object: pose.
        log_likelihood, log_exactness: as those of a verdict's evidence; the second is zero where it
            was not measured, because the first is too small to decide anything.
    """

    model: int
    world_from_object: Float[np.ndarray, "4 4"]
    log_likelihood: float
    log_exactness: float = 0.0

    @property
    def log_odds(self) -> float:
        """The log-likelihood with how exactly the edges fit, by which it is compared."""
        return log_odds_of(self.log_likelihood, self.log_exactness)


class Localization(NamedTuple):
    """An object that was looked for, with the verdict on where it was found.

    Attributes:
        model: of the object.
        model_index: its index among the models that were looked for.
        refined: pose with the parts of its covariance, and the edges it was estimated from.
        verdict: decision, its reasons and its numbers.
        rivals: other explanations of the same edges, the best first.
    """

    model: ObjectModel
    model_index: int
    refined: RefinedPose
    verdict: Verdict
    rivals: tuple[Rival, ...]

    @property
    def world_from_object(self) -> Float[np.ndarray, "4 4"]:
        """The pose of the object; `equivalent_poses` has those that symmetry makes the same."""
        return self.refined.world_from_object

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """The covariance of the pose's tangent at the object, translation (m) first, then rad."""
        return self.refined.covariance

    @property
    def calibration_jacobian(self) -> Float[np.ndarray, "6 shared"] | None:
        """The derivatives of the pose's tangent by the numbers of the calibration.

        Whatever else goes by the same calibration, as a gripper does, errs together with the
        object. None if the calibration was taken as exact.
        """
        # The robot's noise in these views is that of no other motion.
        shared = self.refined.calibration_jacobian[:, : self.refined.shared_count]
        return shared if shared.size else None

    @property
    def accepted(self) -> bool:
        """Whether the verdict is "accepted"."""
        return self.verdict.decision == "accepted"

    @property
    def equivalent_poses(self) -> Float[np.ndarray, "K 4 4"]:
        """The poses that are the same by the model's symmetry, the found one first."""
        return self.world_from_object @ self.model.object_from_object

    @property
    def matches(self) -> tuple[EdgeMatch, ...]:
        """The edges of the model that were measured, view by view."""
        lines, consistent = self.refined.lines, self.refined.consistent
        return tuple(
            EdgeMatch(
                int(view),
                int(edge),
                float(lines.offsets[view, edge, 0]),
                float(lines.visible_px[view, edge]),
                float(lines.found_px[view, edge]),
                bool(consistent[view, edge]),
            )
            for view, edge in zip(*np.nonzero(lines.measured), strict=True)
        )

    @property
    def name(self) -> str:
        """The name of the object in messages: its model's or, without one, the model's index."""
        return model_name(self.model, self.model_index)

    @property
    def message(self) -> str:
        """The verdict in words."""
        reasons = "; ".join(self.verdict.reasons)
        return f"{self.name}: {self.verdict.decision}" + (f": {reasons}" if reasons else "")


class Localizations(tuple[Localization, ...]):
    """A tuple of what was found of all models, accepted ones first, with the pictures it is from.

    Each is a `Localization`. A model of which nothing was found has none, or its best pose
    with the verdict "rejected".

    Attributes:
        messages: for each model that was not accepted, why, in words.
        pictures: of all views so far.
        command: what the robot reported in these views.
    """

    messages: tuple[str, ...]
    pictures: tuple[PictureEvidence, ...]
    command: Command

    def __new__(
        cls,
        found: Iterable[Localization],
        messages: tuple[str, ...],
        pictures: tuple[PictureEvidence, ...],
        command: Command,
    ) -> "Localizations":
        """Return the localizations with what they rest on."""
        self = super().__new__(cls, found)
        self.messages, self.pictures, self.command = messages, pictures, command
        return self

    def __getnewargs__(
        self,
    ) -> tuple[tuple[Localization, ...], tuple[str, ...], tuple[PictureEvidence, ...], Command]:
        """Return the arguments of `__new__`, from which copies and pickles are made."""
        return tuple(self), self.messages, self.pictures, self.command

    @property
    def accepted(self) -> tuple[Localization, ...]:
        """The localizations whose verdict is "accepted"."""
        return tuple(one for one in self if one.accepted)

    @property
    def open(self) -> tuple[Localization, ...]:
        """The localizations whose verdict is "open": a further view may decide."""
        return tuple(one for one in self if one.verdict.decision == "open")
