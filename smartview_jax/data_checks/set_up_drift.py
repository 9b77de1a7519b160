"""Find out whether the set-up drifts: a camera or a target that creeps while the views are taken.

A magnetic foot that slips, a mount that sags, a bracket or an arm that warms up: every view is a
little farther from the first one than the view before. No single view looks wrong, and no place
parts good views from bad ones. Both transforms and the drift are fitted to the closure errors of
all views together, linearly, because all are small.

A robot errs alike in poses near each other, and views that are taken along a path then look as if
they drifted. So the errors are white noise plus a Gaussian process over the robot's poses, whose
size and reach are those that make the views most likely, with the drift and without. A drift is
named if it is likely in spite of them, by Schwarz's criterion.

References:
    Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.7.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ..calibration import mount_frames
from ..geometry import (
    host_adjoints,
    host_exponentials,
    host_logarithms,
    host_matrices,
)
from .closure import MAX_CLOSURE_SCORE, MAX_CORRECTED_SCORE_RATIO, MAX_VIEWS, Poses
from .misfit_evidence import MIN_VARIANCE
from .transform_fit import fit_transforms, median_distance, misfit_text, misfits

REACHES = (0.5, 1.0, 3.0)
"""Reaches of the robot's errors that are tried, in position and in rotation, over the root mean
square difference of the robot's poses."""

RATIOS = (0.0, 1.0, 10.0, 100.0, 1e4)
"""Variances of the robot's errors that are tried, over the variance of the white noise."""


@dataclasses.dataclass(frozen=True)
class DriftOptions:
    """Say which drift of the set-up is named.

    Attributes:
        min_odds: smallest odds of a drift that is named; 150 are "very strong evidence" in the
            words of Kass and Raftery, Bayes factors, 1995.
        min_views: fewest views: transforms, size and drift have 19 numbers, and 6 views 36.
        min_size: smallest drift from the first view to the last: rotation (rad) plus translation
            over the distance to the target. The default is 1 mm at half a metre.
    """

    min_odds: float = 150.0
    min_views: int = 10
    min_size: float = 2e-3


class SetUpDrift(NamedTuple):
    """A drift of the camera on its mount, or of the target on its holder.

    Attributes:
        kind: `"camera"` or `"target"`.
        views: indices of the first view and of the last that were used.
        translation, rotation: of the drift between these two, m and rad.
        misfit: mean misfit over the views without the drift, m and rad.
        given_misfit: the same with the drift.
        score, given_score: rotation plus translation over the distance to the target, of both.
    """

    kind: str
    views: tuple[int, int]
    translation: float
    rotation: float
    misfit: tuple[float, float]
    given_misfit: tuple[float, float]
    score: float
    given_score: float

    @property
    def contradicts(self) -> bool:
        """Whether no calibration can be right for the first views and for the last."""
        return (
            self.given_score > MAX_CLOSURE_SCORE
            and self.score < MAX_CORRECTED_SCORE_RATIO * self.given_score
        )

    def sentence(self, mount: str, view_ids: Sequence[str]) -> str:
        """Return in words what drifts, by how much, and what to do.

        Args:
            mount: where the camera is stated to be.
            view_ids: names of the views.
        """
        in_hand = mount_frames(mount)[0] == "tool"
        if self.kind == "camera":
            place, frame = ("on the tool", "tool") if in_hand else ("next to the robot", "base")
        else:
            place, frame = ("on the table", "base") if in_hand else ("in the hand", "tool")
        size = misfit_text((self.translation, self.rotation))
        first, last = (view_ids[view] for view in self.views)
        return (
            f"the views drift away from the robot's poses, as if the {self.kind} crept {place} by "
            f"{size} from view {first} to view {last} (or the controller's {frame} "
            "frame drifted, the robot warmed up, or it errs along the path of the views): without "
            f"that, robot and camera agree to {misfit_text(self.misfit)} instead of "
            f"{misfit_text(self.given_misfit)} (means over the views). Fasten camera and target, "
            "let the robot warm up, and take the views again, in mixed order"
        )


def find_drift(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    mount: str,
    length_ratio: float = 1.0,
    options: DriftOptions | None = None,
) -> SetUpDrift | None:
    """Return the drift that explains most of the misfit of robot and camera, if there is one.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`, in the order they were taken.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
        mount: where the camera is stated to be.
        length_ratio: of the camera's motion to the robot's, as in `find_change`.
        options: which drift is named; by default `DriftOptions()`.
    """
    options = options or DriftOptions()
    views = np.flatnonzero(used)
    if len(views) < options.min_views:
        return None
    views = views[np.unique(np.linspace(0, len(views) - 1, MAX_VIEWS).round().astype(int))]
    robot, camera = host_matrices(mount_from_holder)[views], host_matrices(camera_from_world)[views]
    if not (np.isfinite(robot).all() and np.isfinite(camera).all()):
        return None
    robot[:, :3, 3] *= length_ratio
    distance = median_distance(camera)
    fit = fit_transforms(robot, camera, np.ones(len(robot), bool))
    at_mount, calibration = host_logarithms(fit.closure), _by_calibration(robot)
    # Views that were left out passed time as well.
    time = 2.0 * (views - views[0]) / (views[-1] - views[0]) - 1.0
    models = {
        kind: np.concatenate([calibration, time[:, None, None] * calibration[..., columns]], axis=2)
        for kind, columns in (("camera", slice(0, 6)), ("target", slice(6, 12)))
    }
    seen = _Errors.likelier(at_mount, calibration, robot @ fit.holder_from_world)
    given, given_score = _mean(at_mount - calibration @ seen.white(calibration).numbers, distance)
    found = []
    for kind in _likely_kinds(seen, calibration, models, robot, options):
        numbers = seen.white(models[kind]).numbers
        change = host_exponentials(2.0 * numbers[-6:])
        translation, rotation = misfits(change[None])[0].tolist()
        misfit, score = _mean(at_mount - models[kind] @ numbers, distance)
        if rotation + translation / distance > options.min_size:
            ends = int(views[0]), int(views[-1])
            sizes = translation, rotation, misfit, given, score, given_score
            found.append(SetUpDrift(kind, ends, *sizes))
    return min(found, key=lambda drift: drift.score, default=None)


def _likely_kinds(
    seen: "_Errors",
    calibration: Float[np.ndarray, "views 6 numbers"],
    models: Mapping[str, Float[np.ndarray, "views 6 _"]],
    mount_from_holder: Poses,
    options: DriftOptions,
) -> list[str]:
    """Return the kinds of drift that are likely, also beyond the robot's own errors."""
    limit = 2.0 * np.log(options.min_odds)
    without = seen.white(calibration)
    kinds = [kind for kind, model in models.items() if _odds(without, seen.white(model)) > limit]
    # A drift is rare: most sets are done with after a look at white errors.
    if not kinds:
        return []
    kernels = _kernels(mount_from_holder)
    without = seen.likeliest(calibration, kernels)
    return [k for k in kinds if _odds(without, seen.likeliest(models[k], kernels)) > limit]


def _by_calibration(mount_from_holder: Poses) -> Float[np.ndarray, "views 6 13"]:
    """Return the derivatives of the closure errors by twists of both transforms, and the size.

    The size scales the robot's motion. A wrong one would hide a target that creeps.
    """
    eye = np.broadcast_to(np.eye(6), (len(mount_from_holder), 6, 6))
    size = np.zeros((len(mount_from_holder), 6, 1))
    size[:, :3, 0] = -mount_from_holder[:, :3, 3]
    return np.concatenate([eye, host_adjoints(mount_from_holder), size], axis=2)


class _Process(NamedTuple):
    """Covariance of errors over the views, relative to their white noise: `1 + U diag(s) U^T`.

    Attributes:
        axes: the eigenvectors U, as columns.
        sizes: the eigenvalues s, of translations and of rotations.
    """

    axes: Float[np.ndarray, "views views"]
    sizes: Float[np.ndarray, "views 2"]

    @classmethod
    def white(cls, count: int) -> "_Process":
        """Return the process of errors that are white noise alone."""
        return cls(np.eye(count), np.zeros((count, 2)))

    def whitened(self, rows: Float[np.ndarray, "views 6 columns"]) -> np.ndarray:
        """Return independent combinations of the views' errors, each of the white noise's size."""
        combined = (self.axes.T @ rows.reshape(len(rows), -1)).reshape(rows.shape)
        return combined / np.repeat(np.sqrt(1.0 + self.sizes), 3, axis=1)[:, :, None]


Kernels = dict[tuple[float, float], tuple[np.ndarray, np.ndarray]]
"""Eigenvectors and eigenvalues of kernels over the robot's poses, by their reaches."""


def _kernels(mount_from_holder: Poses) -> Kernels:
    """Return the kernels that are tried."""
    position = np.linalg.inv(mount_from_holder)[:, :3, 3]
    turns = mount_from_holder[:, None, :3, :3] @ mount_from_holder[None, :, :3, :3].swapaxes(2, 3)
    angle = Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude().reshape(turns.shape[:2])
    by_position = np.sum((position[:, None] - position) ** 2, axis=2)
    by_position, by_angle = (x / max(float(x.mean()), 1e-12) for x in (by_position, angle**2))
    kernels = {}
    for reaches in product(REACHES, REACHES):
        exponent = by_position / reaches[0] ** 2 + by_angle / reaches[1] ** 2
        sizes, axes = np.linalg.eigh(np.exp(-0.5 * exponent))
        kernels[reaches] = axes, np.maximum(sizes, 0.0)
    return kernels


class _Errors(NamedTuple):
    """The closure errors in the frame in which they are more like white noise.

    An arm's errors are independent at the mount; errors of poses from pictures, at the target.

    Attributes:
        values: the errors, m and rad.
        change: to this frame from the mount's, `(views, 6, 6)`.
    """

    values: Float[np.ndarray, "views 6"]
    change: Float[np.ndarray, "views 6 6"]

    @classmethod
    def likelier(
        cls,
        at_mount: Float[np.ndarray, "views 6"],
        model: Float[np.ndarray, "views 6 numbers"],
        mount_from_world: Poses,
    ) -> "_Errors":
        """Return the errors at the mount or at the target, where the model leaves white noise."""
        eye = np.tile(np.eye(6), (len(at_mount), 1, 1))
        changes = eye, host_adjoints(np.linalg.inv(mount_from_world))
        frames = (cls((change @ at_mount[..., None])[..., 0], change) for change in changes)
        return min(frames, key=lambda errors: errors.white(model).likelihood)

    def white(self, model: Float[np.ndarray, "views 6 numbers"]) -> "_LinearFit":
        """Return the fit of a model to errors that are white noise."""
        return _fitted(self.values, self.change @ model, _Process.white(len(model)))

    def likeliest(
        self, model: Float[np.ndarray, "views 6 numbers"], kernels: Kernels
    ) -> "_LinearFit":
        """Return the fit with the process that makes the errors likeliest.

        Reaches and ratios are chosen one after the other, twice.
        """
        choice = [REACHES[1], REACHES[1], RATIOS[2], RATIOS[2]]
        best, turned = None, self.change @ model
        for _ in range(2):
            for place, values in enumerate((REACHES, REACHES, RATIOS, RATIOS)):
                for value in values:
                    tried = [*choice[:place], value, *choice[place + 1 :]]
                    axes, sizes = kernels[tried[0], tried[1]]
                    process = _Process(axes, np.outer(sizes, tried[2:]))
                    fit = _fitted(self.values, turned, process)
                    if best is None or fit.likelihood < best.likelihood:
                        best, choice = fit, tried
        assert best is not None
        return best


class _LinearFit(NamedTuple):
    """A linear model of the closure errors.

    Attributes:
        numbers: its numbers, translation in m and rotation in rad.
        likelihood: minus twice the logarithm of its likelihood, up to a constant.
        error_count: number of errors, six for each view.
    """

    numbers: Float[np.ndarray, "numbers"]
    likelihood: float
    error_count: int


def _odds(without: _LinearFit, drifting: _LinearFit) -> float:
    """Return twice the logarithm of the odds of a drift, by Schwarz's criterion."""
    return without.likelihood - drifting.likelihood - 6.0 * float(np.log(without.error_count))


def _fitted(
    errors: Float[np.ndarray, "views 6"],
    model: Float[np.ndarray, "views 6 numbers"],
    process: _Process,
) -> _LinearFit:
    """Fit a linear model to the closure errors by generalised least squares.

    The variances of translation and rotation are estimated from the errors that remain.
    """
    columns = model.shape[2]
    whole = process.whitened(np.concatenate([model, errors[:, :, None]], axis=2))
    design, independent = whole[..., :columns], whole[..., columns]
    # Units differ by many orders: every column has length one.
    lengths = np.maximum(np.linalg.norm(design, axis=(0, 1)), 1e-300)
    design = design / lengths
    products = np.einsum("vai,vaj->aij", design, design)
    sums = np.einsum("vai,va->ai", design, independent)
    solution, variances = np.zeros(columns), _variances(independent)
    for _ in range(3):
        weights = np.repeat(1.0 / variances, 3)
        gram, right = np.tensordot(weights, products, 1), weights @ sums
        solution = np.linalg.lstsq(gram, right, rcond=1e-12)[0]
        variances = _variances(independent - design @ solution)
    likelihood = 3.0 * len(errors) * np.log(variances).sum() + 3.0 * np.log1p(process.sizes).sum()
    return _LinearFit(solution / lengths, float(likelihood), errors.size)


def _variances(errors: Float[np.ndarray, "views 6"]) -> Float[np.ndarray, "2"]:
    """Return the variances of twists, of translation (m^2) and rotation (rad^2)."""
    return np.maximum(np.mean(errors.reshape(-1, 2, 3) ** 2, axis=(0, 2)), MIN_VARIANCE)


def _mean(
    errors: Float[np.ndarray, "views 6"], distance: float
) -> tuple[tuple[float, float], float]:
    """Return the mean misfit over the views (m and rad), and its score, as `mean_misfit`."""
    translation, rotation = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).mean(axis=0).tolist()
    return (translation, rotation), rotation + translation / distance
