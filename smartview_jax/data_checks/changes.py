"""Find the view from which something was changed: a knocked camera, a moved target, the pictures.

A set-up that changes once, half-way, is two good data sets that contradict each other. Half of the
views then disagree with the other half, so no single view looks wrong, and medians over pairs of
views may stay small. Therefore the transforms are fitted to the views on one side of every
possible change; if the views on the other side disagree with them, but all by the same transform,
that is the change. A lens that zoomed by z makes the camera's poses, which are computed with one
focal length for all views, err in depth only: by one factor before and by z times it after. Where
pictures were mirrored, the other side agrees by one transform once its poses are mirrored back.

A change is named if it is likely (`misfit_evidence.py`) and large. It is large if it explains more
than all else together: by a size s half-way, it leaves s / 2 in every view of a fit to all of them.
In many views a smaller knock of the camera may be certain, though it is less than the robot's noise
in each of them, and it displaces the answer by more than that noise does. So a move of the camera
that is very likely needs no size. Other changes do: depths err with the lens and the target's size
as well, and the tilt of a flat target errs about an axis of its own.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float, Int

from ..geometry import host_adjoints, host_exponentials, host_logarithms, mean_matrix
from .closure import MAX_CLOSURE_SCORE, Poses, contradicts_calibration, explains_most
from .misfit_evidence import VERY_STRONG_EVIDENCE, evidence, in_parts
from .picture_turns import MIRRORED, PictureTurn, mirrored_poses, turn_of_change
from .smooth_errors import ViewErrors, by_transforms, left_over_errors
from .step_gains import step_gains
from .transform_fit import (
    TransformFit,
    fit_transforms,
    mean_misfit,
    mean_size,
    median_distance,
    misfit_text,
    misfits,
    motions_from_camera_to_target,
    moved_text,
)

MAX_ZOOM = 5.0
"""Largest ratio of two focal lengths that is taken for a zoom, either way."""


@dataclasses.dataclass(frozen=True)
class ChangeOptions:
    """Say where a change is looked for, and which one is named.

    Attributes:
        min_odds: smallest odds of a large change that is named. Changes are rare.
        min_odds_of_any_size: the same of a move of the camera of any size.
        min_promise: smallest part of the evidence that a change needs, to first order, with which
            it is fitted.
        min_views_on_a_side: fewest views before and after a change. Of six good views of a real
            arm, three may agree with a moved camera by chance.
        max_rival_ratio: ratio to the smallest misfit up to which another kind of change explains
            the views as well.
        min_score: smallest score without a change with which one is looked for; the default is 1 mm
            at half a metre.
        max_tried_places: largest number of places where a change is looked for at first; then of
            places around the best of them, until none is left between.
    """

    min_odds: float = VERY_STRONG_EVIDENCE
    min_odds_of_any_size: float = VERY_STRONG_EVIDENCE
    min_promise: float = 0.75
    min_views_on_a_side: int = 4
    max_rival_ratio: float = 2.0
    min_score: float = 2e-3
    max_tried_places: int = 8

    def __post_init__(self) -> None:
        if self.max_tried_places < 3:
            raise ValueError(
                "ChangeOptions.max_tried_places: expected at least three, which narrow a search, "
                f"found {self.max_tried_places}"
            )

    def are_met_by(self, change: "Change") -> bool:
        """Return whether a change is likely and large, or very likely, so that it is named."""
        logarithm = 0.5 * change.evidence
        is_certain = logarithm > np.log(self.min_odds_of_any_size)
        is_large = 0.5 * change.size > change.score
        is_named = logarithm > np.log(self.min_odds) and is_large
        return bool(is_named or (change.kind == "camera" and is_certain))


class Change(NamedTuple):
    """A change of the set-up between two views.

    Attributes:
        kind: `"camera"` for the camera against its mount, `"target"` for the target against its
            holder, `"zoom"` for the lens, `"mirror"` for pictures that were mirrored.
        first_view: index of the first view after it.
        translation, rotation: size of the change of the frame, m and rad; for a zoom, by how much
            the target seems to come nearer or to recede.
        zoom: ratio of the focal length after the change to the one before; 1 for other kinds.
        turn: how the pictures on one side of the change seem to be turned or mirrored against the
            other side's; None for other changes.
        misfit: mean misfit over the views with the change, m and rad.
        score: rotation plus translation over the distance to the target.
        size: the same of the change itself.
        evidence: difference of Schwarz's criterion, without the change minus with it: twice the
            logarithm of the odds of the change.
    """

    kind: str
    first_view: int
    translation: float
    rotation: float
    zoom: float
    turn: PictureTurn | None
    misfit: tuple[float, float]
    score: float
    size: float
    evidence: float


class ChangeReport(NamedTuple):
    """A change of the set-up, as far as the views tell it, and what it explains.

    Attributes:
        changes: the change that explains the views best, and others that do so about as well.
        misfit: mean misfit over the views without any change, m and rad.
        score: as in `Change`, without any change.
        likeliest_kind: kind of the likeliest change of any size, also where it is not named.
    """

    changes: tuple[Change, ...]
    misfit: tuple[float, float]
    score: float
    likeliest_kind: str

    @property
    def contradicts(self) -> bool:
        """Whether no calibration can be right for the views before the change and after it."""
        return contradicts_calibration(self.changes[0].score, self.score)

    @property
    def explains_most(self) -> bool:
        """Whether robot and camera agree far better with the change."""
        return explains_most(self.changes[0].score, self.score)

    def sentence(self, mount: str, view_ids: Sequence[str]) -> str:
        """Return in words what changed, from which view on, and what to do.

        Args:
            mount: where the camera is stated to be.
            view_ids: names of the views.
        """
        best = self.changes[0]
        causes = ", or as if ".join(_causes(change, mount) for change in self.changes)
        advice = "Calibrate the two parts separately"
        if best.turn is not None:
            advice = best.turn.advice
        return (
            f"from view {view_ids[best.first_view]} on, the views contradict the earlier ones, as "
            f"if {causes}: with such a change robot and camera agree to "
            f"{misfit_text(best.misfit)} instead of {misfit_text(self.misfit)} (means over the "
            f"views). {advice}"
        )


def _causes(change: Change, mount: str) -> str:
    """Return what may have been changed, and by how much, as a clause."""
    if change.kind == "zoom":
        return f"the lens had zoomed by {100.0 * (change.zoom - 1.0):+.1f} %"
    if change.turn is not None:
        return f"{change.turn.clause}, before it or after it"
    return moved_text(change.kind, mount, (change.translation, change.rotation))


def find_change(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    length_ratio: float = 1.0,
    options: ChangeOptions | None = None,
) -> ChangeReport | None:
    """Return the change that explains most of the disagreement of robot and camera; None without.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`, in the order they were taken.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
        length_ratio: of the camera's motion to the robot's. A target of another size than stated
            would otherwise hide a small change.
        options: where a change is looked for; by default `ChangeOptions()`.
    """
    options = options or ChangeOptions()
    views, fewest = np.flatnonzero(used), options.min_views_on_a_side
    if len(views) < 2 * fewest:
        return None
    motions = motions_from_camera_to_target(
        mount_from_holder, camera_from_world, views, length_ratio
    )
    if motions is None:
        return None
    robot, camera = motions
    places = np.arange(fewest, len(views) - fewest + 1)
    search = _Search.of(robot, camera, len(places))
    if search.score < options.min_score:
        return None
    places = search.promising(places, options)
    if not len(places):
        return None
    tried: dict[int, list[Change]] = {}
    near, step = places, 0
    while step != 1:
        step = int(np.ceil(len(near) / options.max_tried_places))
        spread = np.linspace(0, len(near) - 1, options.max_tried_places)
        for place in near[np.unique(spread.astype(int))].tolist():
            if place not in tried:
                tried[place] = list(search.changes(place))
        best = max(tried, key=lambda place: max(change.evidence for change in tried[place]))
        near = places[np.abs(places - best) < step]
    best_of_kind: dict[str, Change] = {}
    for change in sorted(chain.from_iterable(tried.values()), key=lambda change: -change.evidence):
        best_of_kind.setdefault(change.kind, change)
    named = [change for change in best_of_kind.values() if options.are_met_by(change)]
    if not named:
        return None
    changes = tuple(
        change._replace(first_view=int(views[change.first_view]))
        for change in named
        if change.score <= options.max_rival_ratio * named[0].score
    )
    return ChangeReport(changes, search.misfit, search.score, next(iter(best_of_kind)))


def evidence_of_change(mount_from_holder: SE3, camera_from_world: SE3, first_view: int) -> float:
    """Return the evidence, as in `Change`, for a change of camera or pictures before a view.

    Args:
        mount_from_holder: as in `find_change`; all views are used.
        camera_from_world: from the pictures alone, `(views)`.
        first_view: index of the first view after the change.

    Returns:
        Minus infinity if a pose is not finite, or too few views are before or after the change.
    """
    views = np.arange(camera_from_world.get_batch_axes()[0])
    if min(first_view, len(views) - first_view) < ChangeOptions().min_views_on_a_side:
        return -np.inf
    motions = motions_from_camera_to_target(mount_from_holder, camera_from_world, views, 1.0)
    if motions is None:
        return -np.inf
    changes = _Search.of(*motions, place_count=1).changes(first_view)
    return max(change.evidence for change in changes if change.kind != "target")


_COLUMNS = {"camera": slice(0, 6), "target": slice(6, 12), "zoom": slice(12, 13)}
"""Columns of the derivatives by both transforms, then by the depths, that a change adds."""

_PARAMETERS = {"camera": 6, "target": 6, "zoom": 2}
"""Numbers of each kind of change; a zoom has the depths before it and after it."""


class _Search(NamedTuple):
    """Views in which a change is looked for.

    Attributes:
        robot: `mount_from_holder` of the views.
        camera: `camera_from_world` of the views.
        fit: the transforms that fit all views, without any change.
        by_transforms: derivatives of closure errors by both transforms.
        seen: closure errors without any change, in the frame in which they are likelier.
        errors: what the likeliest transforms leave over of them, m and rad.
        misfit, score: its mean over the views, as in `ChangeReport`.
        distance: median distance of the target, m.
        place_count: number of places where a change may be.
    """

    robot: Poses
    camera: Poses
    fit: TransformFit
    by_transforms: Float[np.ndarray, "views 6 12"]
    seen: ViewErrors
    errors: Float[np.ndarray, "views 6"]
    misfit: tuple[float, float]
    score: float
    distance: float
    place_count: int

    @classmethod
    def of(cls, robot: Poses, camera: Poses, place_count: int) -> "_Search":
        """Return the search in some views."""
        fit = fit_transforms(robot, camera)
        distance, columns = median_distance(camera), by_transforms(robot)
        at_mount = host_logarithms(fit.closure)
        seen = ViewErrors.likelier(at_mount, columns, robot @ fit.holder_from_world)
        errors = seen.left_over(columns, seen.white(columns))
        misfit, score = mean_size(errors, distance)
        return cls(robot, camera, fit, columns, seen, errors, misfit, score, distance, place_count)

    def promising(
        self, places: Int[np.ndarray, "places"], options: ChangeOptions
    ) -> Int[np.ndarray, "promising"]:
        """Return the places where a change promises the needed evidence, to first order.

        Errors that are too large for a first order leave all places.
        """
        if self.score >= MAX_CLOSURE_SCORE:
            return places
        odds = min(options.min_odds, options.min_odds_of_any_size)
        needed = 2.0 * np.log(odds * self.place_count)
        by_change = np.concatenate([self.by_transforms, self._by_depth(self.fit)], axis=2)
        model, changes = (self.seen.change @ x for x in (self.by_transforms, by_change))
        promises = [
            step_gains(self.errors, model, changes[..., columns])[places]
            / (needed + _PARAMETERS[kind] * np.log(len(self.robot)))
            for kind, columns in _COLUMNS.items()
        ]
        promise = np.max(promises, axis=0)
        best = np.argsort(-promise)[: options.max_tried_places]
        return np.sort(places[best[promise[best] > options.min_promise]])

    def _by_depth(self, fit: TransformFit) -> Float[np.ndarray, "views 6 1"]:
        """Return the derivatives of closure errors by the share by which depths are larger."""
        along = host_adjoints(np.linalg.inv(fit.camera_from_mount))[:, 2]
        return (along * self.camera[:, 2, 3, None])[..., None]

    def changes(self, place: int) -> Iterator[Change]:
        """Yield the changes of each kind before the view `place`."""
        after = np.arange(len(self.robot)) >= place
        # The transforms of the side with more views, from which the other side differs.
        reference = after if 2 * after.sum() >= len(after) else ~after
        fit = fit_transforms(self.robot, self.camera, reference)
        yield from self._moves(place, fit, reference, fit.closure)
        yield from self._mirrors(place, fit, reference)
        before_factor, after_factor = self._depth_factors(after)
        # No lens zooms so far between two pictures of one target; poses that fit nothing seem to.
        if not (before_factor > 0.0 and 1.0 / MAX_ZOOM < after_factor / before_factor < MAX_ZOOM):
            return
        camera = self.camera.copy()
        camera[:, 2, 3] *= np.where(after, after_factor, before_factor)
        corrected = fit_transforms(self.robot, camera)
        factors = np.where(after, after_factor, before_factor)[:, None, None]
        by_depth, later = factors * self._by_depth(corrected), after[:, None, None]
        by_depths = np.concatenate([~later * by_depth, later * by_depth], axis=2)
        errors, shares = self._explained(corrected.closure, by_depths)
        zoom = after_factor * (1.0 - shares[1]) / (before_factor * (1.0 - shares[0]))
        moved = abs(zoom - 1.0) * self.distance, 0.0
        yield self._change("zoom", place, moved, errors)._replace(zoom=zoom)

    def _moves(
        self, place: int, fit: TransformFit, reference: Bool[np.ndarray, "views"], closure: Poses
    ) -> Iterator[Change]:
        """Yield the changes of camera and target by which the other side agrees with the reference.

        Args:
            place: index of the first view after the change.
            fit: of the side that is the reference.
            reference: mask of its views.
            closure: of all views with that fit.
        """
        other, robot = ~reference, self.robot[~reference]
        for kind in ("camera", "target"):
            corrected = closure.copy()
            if kind == "camera":
                change = mean_matrix(closure[other], np.ones(len(robot)))
                corrected[other] = np.linalg.inv(change) @ closure[other]
            else:
                at_target = np.linalg.inv(robot) @ closure[other] @ robot
                change = mean_matrix(at_target, np.ones(len(robot)))
                corrected[other] = robot @ np.linalg.inv(change) @ at_target @ np.linalg.inv(robot)
            of_other = other[:, None, None] * self.by_transforms[:, :, _COLUMNS[kind]]
            errors, step = self._explained(corrected, of_other)
            change = change @ host_exponentials(step)
            translation, rotation = misfits(change).tolist()
            named = self._change(kind, place, (translation, rotation), errors)
            if kind == "camera":
                turn = turn_of_change(fit.camera_from_mount, change, self.distance)
                named = named._replace(turn=turn)
            yield named

    def _explained(
        self, closure: Poses, columns: Float[np.ndarray, "views 6 numbers"]
    ) -> tuple[Float[np.ndarray, "views 6"], Float[np.ndarray, "numbers"]]:
        """Return the errors left over with a change, and the likeliest last step of its numbers.

        Args:
            closure: of the views, corrected for the change.
            columns: derivatives of the closure errors by the numbers of the change.
        """
        model = np.concatenate([self.by_transforms, columns], axis=2)
        errors, numbers = left_over_errors(closure, model, self.robot @ self.fit.holder_from_world)
        return errors, numbers[12:]

    def _mirrors(
        self, place: int, fit: TransformFit, reference: Bool[np.ndarray, "views"]
    ) -> Iterator[Change]:
        """Yield the changes with which the other side agrees if its pictures were mirrored.

        The arguments are as of `_moves`.
        """
        # Mirrored pictures of a target that is tilted by some degrees contradict the others by far.
        if self.score < MAX_CLOSURE_SCORE:
            return
        mirrored = self.camera.copy()
        mirrored[~reference] = mirrored_poses(self.camera[~reference])
        # What is left over after mirroring is small, but what mirroring explains is not.
        (translation, rotation), size = mean_misfit(fit.closure[~reference], self.distance)
        for move in self._moves(place, fit, reference, fit.closure_of(self.robot, mirrored)):
            yield move._replace(
                kind="mirror",
                translation=translation,
                rotation=rotation,
                turn=MIRRORED,
                size=size,
            )

    def _depth_factors(self, after: Bool[np.ndarray, "views"]) -> tuple[float, float]:
        """Return true depth over measured depth, before and after a zoom.

        With the hand-eye rotation R, the translations of the chain camera = X robot W are linear in
        the unknown x, w (of the transforms X and W) and factors f:

            (c_x, c_y, f c_z) = x + R (R_robot w + t_robot)
        """
        count, turn = len(self.robot), self.fit.camera_from_mount[:3, :3]
        measured = self.camera[:, :3, 3]
        matrix = np.zeros((count, 3, 8))
        matrix[:, :, :3] = np.eye(3)
        matrix[:, :, 3:6] = turn @ self.robot[:, :3, :3]
        matrix[~after, 2, 6] = -measured[~after, 2]
        matrix[after, 2, 7] = -measured[after, 2]
        known = -self.robot[:, :3, 3] @ turn.T
        known[:, :2] += measured[:, :2]
        solution = np.linalg.lstsq(matrix.reshape(-1, 8), known.ravel(), rcond=None)[0]
        return float(solution[6]), float(solution[7])

    def _change(
        self,
        kind: str,
        place: int,
        moved: tuple[float, float],
        errors: Float[np.ndarray, "views 6"],
    ) -> Change:
        """Return a change with the misfit and the evidence of the errors that it leaves over."""
        misfit, score = mean_size(errors, self.distance)
        size = moved[1] + moved[0] / self.distance
        # A change may be at any place.
        odds = evidence(in_parts(self.errors), in_parts(errors), _PARAMETERS[kind])
        odds -= 2.0 * float(np.log(self.place_count))
        return Change(kind, place, *moved, 1.0, None, misfit, score, size, odds)
