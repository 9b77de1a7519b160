"""Hold the result for an object that was searched: pose, covariance, verdict and rivals."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...features import PictureEvidence
from ...modeling import AnyCalibration, ObjectModel
from ...robots import Command
from ..refining import RefinedPose
from .evidence import log_odds_of
from .verdict import Verdict


def model_name(model: ObjectModel, index: int) -> str:
    """Return the name of a model in messages: its name or, without one, its index."""
    return model.name or f"model {index}"


class EdgeMatch(NamedTuple):
    """An edge of the model that was measured in a view.

    Attributes:
        view, edge: indices of the view and of the model's edge.
        distance: mean distance of the edge points from the predicted edge, px.
        visible_px: visible length of the edge, px.
        found_px: length with edge points, px.
        consistent: whether the distance agrees with its noise; other edges contradict the pose and
            have little weight.
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
        log_likelihood, log_exactness: as in `Evidence`; the second is zero where it was not
            measured, because the first is too small to matter.
    """

    model: int
    world_from_object: Float[np.ndarray, "4 4"]
    log_likelihood: float
    log_exactness: float = 0.0

    @property
    def log_odds(self) -> float:
        """The log-likelihood ratio with the exactness of the fit, by which poses are compared."""
        return log_odds_of(self.log_likelihood, self.log_exactness)


class Localization(NamedTuple):
    """An object that was searched, with the verdict on the pose where it was found.

    Attributes:
        model: of the object.
        model_index: its index among the models that were searched.
        refined: pose with the parts of its covariance, and the edges it was estimated from.
        verdict: decision, reasons and numbers.
        rivals: other explanations of the same edges, the best first.
        scale: size of the searched pictures over the given ones (`PictureEvidence.scale`); all
            lengths in px are of the searched pictures.
        frame: frame of the pose and its covariance: `"world"`, or `"base"` (see `RigViews`).

    For example, with `search` as for `localize`:

        >>> sv.localize(*search).accepted[0].verdict.decision  # doctest: +SKIP
        'accepted'
    """

    model: ObjectModel
    model_index: int
    refined: RefinedPose
    verdict: Verdict
    rivals: tuple[Rival, ...]
    scale: float = 1.0
    frame: str = "world"

    @property
    def world_from_object(self) -> Float[np.ndarray, "4 4"]:
        """The pose of the object in `frame`; `equivalent_poses` lists those equal by symmetry."""
        return self.refined.world_from_object

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """The covariance of the pose's tangent at the object, translation (m) first, then rad."""
        return self.refined.covariance

    @property
    def calibration_jacobian(self) -> Float[np.ndarray, "6 shared"] | None:
        """The derivatives of the pose's tangent by the numbers of the calibration.

        Errors of the calibration move the object together with everything else located by it, such
        as a gripper. None if the calibration was taken as exact.
        """
        # The robot's noise in these views is not shared with any other motion.
        shared = self.refined.calibration_jacobian[:, : len(self.refined.shared_names)]
        return shared if shared.size else None

    @property
    def calibration_names(self) -> tuple[str, ...]:
        """The names of these numbers, as in the fit; for several cameras, as in the rig's fit."""
        return self.refined.shared_names

    @property
    def accepted(self) -> bool:
        """Whether the verdict is "accepted"."""
        return self.verdict.decision == "accepted"

    @property
    def equivalent_poses(self) -> Float[np.ndarray, "K 4 4"]:
        """The poses that are equal by the model's symmetry, the found one first."""
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
        """The name of the object in messages: the model's name or, without one, its index."""
        return model_name(self.model, self.model_index)

    @property
    def message(self) -> str:
        """The verdict in words."""
        reasons = "; ".join(self.verdict.reasons)
        return f"{self.name}: {self.verdict.decision}" + (f": {reasons}" if reasons else "")


class Localizations(tuple[Localization, ...]):
    """A tuple of the results for all models, accepted ones first, with their pictures.

    Each is a `Localization`. A model that was not found has none, or its best pose with the verdict
    "rejected".

    Attributes:
        messages: for each model that was not accepted, the reason; and where the search ended
            before all poses were judged.
        pictures: of all views so far.
        command: what the robot reported in these views.
        calibration: with which they were read, or the cameras that took them; None if unknown.
    """

    messages: tuple[str, ...]
    pictures: tuple[PictureEvidence, ...]
    command: Command
    calibration: AnyCalibration | None

    def __new__(
        cls,
        localizations: Iterable[Localization],
        messages: tuple[str, ...],
        pictures: tuple[PictureEvidence, ...],
        command: Command,
        calibration: AnyCalibration | None = None,
    ) -> "Localizations":
        """Return the localizations with their messages, pictures, command and calibration."""
        self = super().__new__(cls, localizations)
        self.messages, self.pictures, self.command = messages, pictures, command
        self.calibration = calibration
        return self

    def __getnewargs__(
        self,
    ) -> tuple[
        tuple[Localization, ...],
        tuple[str, ...],
        tuple[PictureEvidence, ...],
        Command,
        AnyCalibration | None,
    ]:
        """Return the arguments of `__new__`, for copies and pickles."""
        return tuple(self), self.messages, self.pictures, self.command, self.calibration

    @property
    def accepted(self) -> tuple[Localization, ...]:
        """The localizations whose verdict is "accepted"."""
        return tuple(result for result in self if result.accepted)

    @property
    def open(self) -> tuple[Localization, ...]:
        """The localizations whose verdict is "open": a further view may decide."""
        return tuple(result for result in self if result.verdict.decision == "open")
