"""Find out that the focal length changed between the pictures: autofocus, or a lens that breathes.

Within one view a longer focal length looks like a nearer target, so that one camera fits all views
although it had another focal length in each. Robot and camera then disagree along the optical axis,
by a share of the distance. Whatever else errs knows nothing of the optical axis: the robot errs
alike in all directions, or along an axis of its base as a worn lift does. So the positions are
fitted with errors of each kind (`position_equations.py`), and the kinds compared by Schwarz's
criterion. Points in pictures tell the distance less well than the direction, by an amount that
follows from their noise and is part of each kind.

Where single pictures explain the errors better than a change in all of them, as a picture that was
zoomed, cropped or taken by another camera, these views are named. So is the first view of all later
ones, where one change explains them better.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize

from ..argument_checks import listed
from ..calibration import mount_frames
from .changes import ChangeOptions
from .largest_group import MAX_DISAGREEMENT, largest_group
from .misfit_evidence import MIN_VARIANCE, VERY_STRONG_EVIDENCE
from .position_equations import fit_positions, robot_column, transform_columns
from .transform_fit import fit_transforms, median_distance, motions_of_views
from .view_consistency import MAX_REJECTED_FRACTION

MIN_VIEWS = 8
"""Fewest views: transforms, size, focal length and variances have 10 numbers, 8 views 24."""

MIN_SIZE = 1e-3
"""Smallest standard deviation of the focal length, relative.

It moves the target by half a millimetre at half a metre, which no good robot errs by.
"""

MAX_LOGARITHM = 50.0
"""Largest logarithm of a standard deviation: a search that steps far still has finite numbers."""


class FocusChange(NamedTuple):
    """Changes of the focal length between the pictures.

    Attributes:
        relative_std: standard deviation of the focal length, over its mean.
        along, across: standard deviations of the errors along the optical axis and across it, m.
        views: indices of the only views with another focal length, or of the first of all that
            have it; empty if it changes in all.
        ratios: their focal lengths over the other views'.
        is_once: whether the focal length changed once, before the only one of `views`.
    """

    relative_std: float
    along: float
    across: float
    views: tuple[int, ...] = ()
    ratios: tuple[float, ...] = ()
    is_once: bool = False

    def sentence(self, view_ids: Sequence[str]) -> str:
        """Return the fault of the pictures in words, and what to do.

        Args:
            view_ids: names of all views.
        """
        if self.is_once:
            return (
                f"from view {view_ids[self.views[0]]} on, the focal length seems to be another "
                f"({100.0 * (self.ratios[0] - 1.0):+.2g} %), as if the lens had zoomed or focused "
                "once, or later pictures were cut and resized: without this, robot and camera "
                f"agree to {1e3 * self.across:.2g} mm. Calibrate the two parts separately"
            )
        if self.views:
            names = [
                f"{view_ids[view]} ({100.0 * (ratio - 1.0):+.2g} %)"
                for view, ratio in zip(self.views, self.ratios, strict=True)
            ]
            several = len(names) > 1
            return (
                f"the focal length seems to be another in view{'s' * several} "
                f"{listed(names)}, as in {'' if several else 'a '}picture"
                f"{'s' * several} with another zoom or focus, of another camera, or cut and "
                "resized: without this, robot and camera agree to "
                f"{1e3 * self.across:.2g} mm. Take {'them' if several else 'it'} again, or leave "
                f"{'them' if several else 'it'} out"
            )
        return (
            "the focal length seems to change from picture to picture, by "
            f"{100.0 * self.relative_std:.2g} % (standard deviation), as with autofocus, zoom or a "
            "lens that breathes: robot and camera disagree by "
            f"{1e3 * self.along:.2g} mm along the optical axis, and by only "
            f"{1e3 * self.across:.2g} mm across it. Switch autofocus off, fix focus and zoom, let "
            "the camera stand still (a rolling shutter stretches pictures), and take them again"
        )


class SeenDistances(NamedTuple):
    """The distance of the target in each view, as the pictures tell it.

    Attributes:
        middle: of the target's points, m.
        noise: standard deviation of each view's distance by the points' noise, relative, `(views)`.
    """

    middle: Float[np.ndarray, "3"]
    noise: Float[np.ndarray, "views"]

    @classmethod
    def of_points(
        cls,
        points: Float[np.ndarray, "views points 3"],
        pixels: Float[np.ndarray, "views points 2"],
        visible: Bool[np.ndarray, "views points"],
        pixel_sigma: float,
    ) -> "SeenDistances":
        """Return the middle of the points and the noise that the size of their pictures has.

        Args:
            points: of the target, m.
            pixels: where they are seen, px.
            visible: mask of the points to use.
            pixel_sigma: standard deviation of u and v, px.
        """
        seen = np.where(visible[..., None], pixels, np.nan)
        with np.errstate(invalid="ignore"):
            count = np.maximum(visible.sum(axis=1), 1)[:, None, None]
            from_middle = seen - np.nansum(seen, axis=1, keepdims=True) / count
            spread = np.sqrt(np.nansum(from_middle**2, axis=(1, 2)))
        return cls(points.reshape(-1, 3).mean(axis=0), pixel_sigma / np.maximum(spread, 1e-9))


def find_focus_change(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    seen: SeenDistances,
    mount: str,
) -> FocusChange | None:
    """Return the changes of the focal length, if errors lie along the optical axis.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
        seen: what the pictures tell of the distances.
        mount: where the camera is stated to be.

    Returns:
        None if the focal length does not seem to change.
    """
    views = np.flatnonzero(used)
    if len(views) < MIN_VIEWS:
        return None
    motions = motions_of_views(mount_from_holder, camera_from_world, views, 1.0)
    if motions is None:
        return None
    robot, camera = motions
    fit = fit_transforms(robot, camera)
    camera_from_mount = fit.camera_from_mount
    # The middle of the target: its corners are farther or nearer where its tilt is seen wrongly.
    positions = camera[:, :3, :3] @ seen.middle + camera[:, :3, 3]
    depths = positions[:, 2]
    if not (depths > 0.0).all():
        return None
    along = np.zeros((len(views), 3))
    along[:, 2] = depths
    columns = (
        transform_columns(robot, camera_from_mount),
        robot_column(robot, camera_from_mount),
        # A focal length that is wrong in all views alike.
        along[..., None],
    )
    columns = np.concatenate(columns, axis=2)
    noise = _outer_products(along * seen.noise[views, None])
    errors = _Positions.of(columns, positions, noise)
    numbers = np.log(3.0 * len(views))
    least_gain = 2.0 * np.log(VERY_STRONG_EVIDENCE)
    # A good robot is done with here: searches for variances take much longer.
    highest = errors.deviance(np.log([errors.sigma])) - numbers - least_gain
    if errors.least_deviance(MIN_SIZE * depths) > highest:
        return None
    # No lens turns the target: a picture whose rotation does not fit was taken at another pose.
    if (fit.misfit[:, 1] > MAX_DISAGREEMENT).any():
        turned = ~largest_group(robot, camera, np.inf)
        if 0 < turned.sum() <= MAX_REJECTED_FRACTION * len(views):
            rest = used.copy()
            rest[views[turned]] = False
            return find_focus_change(mount_from_holder, camera_from_world, rest, seen, mount)
    focus = errors.likelihood(along)
    size = focus.size
    if size < MIN_SIZE:
        return None
    if errors.likelihood(None).deviance - focus.deviance - numbers < least_gain:
        return None
    # The axes of the base: of the holder, or of the mount if the camera stands next to the arm.
    is_on_base = mount_frames(mount)[0] == "base"
    rotations = np.broadcast_to(np.eye(3), (len(views), 3, 3)) if is_on_base else robot[:, :3, :3]
    axes = (camera_from_mount[:3, :3] @ rotations).transpose(2, 0, 1)
    # `any` asks no further axis after the first that explains the errors about as well.
    if any(errors.likelihood(axis).deviance - focus.deviance < least_gain for axis in axes):
        return None
    change = FocusChange(size, size * median_distance(camera), focus.sigma)
    to_beat = focus.deviance + numbers
    once = _change_of_later_views(errors, along, views)
    if once.deviance < to_beat:
        change, to_beat = once
    single = _change_of_single_views(errors, along, views, to_beat)
    return change if single is None else single


class _Explanation(NamedTuple):
    """A change of the focal length in some views, and how likely it is.

    Attributes:
        change: the change.
        deviance: minus twice the logarithm of its likelihood, with the penalty of its numbers.
    """

    change: FocusChange
    deviance: float


def _change_of_later_views(
    errors: "_Positions", along: Float[np.ndarray, "views 3"], views: Int[np.ndarray, "views"]
) -> _Explanation:
    """Return the likeliest single change, after which all views have another focal length.

    The arguments are as of `_change_of_single_views`.
    """
    count, fewest = len(views), ChangeOptions().min_views_on_a_side
    places = np.arange(fewest, count - fewest + 1)
    is_later = np.arange(count) >= places[:, None]
    later = is_later[errors.most_explaining(along, is_later)[0]]
    explained = errors.with_free_groups(along, later[None])
    fit = explained.likelihood(None)
    # Two numbers: the focal length, and the place.
    deviance = fit.deviance + float(np.log(3.0 * count) + 2.0 * np.log(len(places)))
    share = float(fit_positions(explained.columns, errors.positions).numbers[-1])
    relative = abs(share) * float(np.sqrt(np.mean(later) * np.mean(~later)))
    size = relative * float(np.median(along[:, 2]))
    first = int(views[np.argmax(later)])
    change = FocusChange(relative, size, fit.sigma, (first,), (1.0 - share,), is_once=True)
    return _Explanation(change, deviance)


def _change_of_single_views(
    errors: "_Positions",
    along: Float[np.ndarray, "views 3"],
    views: Int[np.ndarray, "views"],
    deviance_to_beat: float,
) -> FocusChange | None:
    """Return the change if few views with another focal length explain the errors better; or None.

    Args:
        errors: positions without any change.
        along: vector from the camera to the target's depth in each view, m.
        views: indices of the views among all.
        deviance_to_beat: of the best other change, with the penalty of its numbers.
    """
    count, chosen = len(views), list[int]()
    each_view = np.eye(count, dtype=bool)
    # A number for each view, which may be any.
    penalty = np.log(3.0 * count) + 2.0 * np.log(count)
    explained = errors
    while len(chosen) < MAX_REJECTED_FRACTION * count - 1.0:
        view, left_over = explained.most_explaining(along, each_view)
        # By less than its number costs no view stands out from the others.
        if -3.0 * count * np.log(left_over) < penalty:
            return None
        chosen.append(view)
        explained = errors.with_free_groups(along, each_view[chosen])
        fit = explained.likelihood(None)
        if fit.deviance + len(chosen) * penalty < deviance_to_beat:
            shares = fit_positions(explained.columns, errors.positions).numbers[-len(chosen) :]
            order = np.argsort(chosen)
            # A longer focal length shortens the distance that the picture seems to have.
            ratios = tuple(float(1.0 - shares[k]) for k in order)
            relative = float(np.sqrt(np.sum(shares**2) / count))
            size = relative * float(np.median(along[:, 2]))
            indices = tuple(int(views[chosen[k]]) for k in order)
            return FocusChange(relative, size, fit.sigma, indices, ratios)
    return None


class _Likelihood(NamedTuple):
    """Errors that make positions most likely.

    Attributes:
        sigma: standard deviation of the errors in any direction, m.
        size: of the errors along the vectors, in their unit.
        deviance: minus twice the logarithm of the likelihood, but for a constant.
    """

    sigma: float
    size: float
    deviance: float


_EYE = np.eye(3)


def _outer_products(vectors: Float[np.ndarray, "views 3"]) -> Float[np.ndarray, "views 3 3"]:
    """Return the product of each vector with itself."""
    return vectors[:, :, None] * vectors[:, None, :]


class _Positions(NamedTuple):
    """Positions, and what explains them.

    Attributes:
        columns: of the numbers that explain them.
        positions: of the target in each view, in the camera's axes, m.
        noise: products of each view's noise of the pictures, as a vector, with itself, m^2.
        equations: an orthonormal basis of the columns, and the positions as the last column.
    """

    columns: Float[np.ndarray, "views 3 numbers"]
    positions: Float[np.ndarray, "views 3"]
    noise: Float[np.ndarray, "views 3 3"]
    equations: Float[np.ndarray, "views 3 terms"]

    @classmethod
    def of(
        cls,
        columns: Float[np.ndarray, "views 3 numbers"],
        positions: Float[np.ndarray, "views 3"],
        noise: Float[np.ndarray, "views 3 3"],
    ) -> "_Positions":
        """Prepare what the likelihoods of all standard deviations have in common."""
        basis, sizes, _ = np.linalg.svd(columns.reshape(-1, columns.shape[2]), full_matrices=False)
        basis = basis[:, sizes > 1e-9 * sizes[0]].reshape(*positions.shape, -1)
        equations = np.concatenate([basis, positions[..., None]], axis=2)
        return cls(columns, positions, noise, equations)

    def with_free_groups(
        self, vectors: Float[np.ndarray, "views 3"], groups: Bool[np.ndarray, "groups views"]
    ) -> "_Positions":
        """Return the positions if groups of views move along their vectors, each by one number."""
        columns = np.where(groups[..., None], vectors, 0.0).transpose(1, 2, 0)
        columns = np.concatenate([self.columns, columns], axis=2)
        return _Positions.of(columns, self.positions, self.noise)

    def most_explaining(
        self, vectors: Float[np.ndarray, "views 3"], groups: Bool[np.ndarray, "groups views"]
    ) -> tuple[int, float]:
        """Return which group's error along its vectors explains most, and what it leaves over.

        What it leaves over is the ratio of the sums of squares with and without its column.
        """
        basis = self.equations[:, :, :-1]
        flat = basis.reshape(-1, basis.shape[2])
        errors = self.positions - basis @ (flat.T @ self.positions.ravel())
        # Of a group's column c, what no other column has is (I - B B^T) c, with the basis B.
        squares = groups @ np.sum(vectors**2, axis=1)
        shared = groups @ np.einsum("vin,vi->vn", basis, vectors)
        own = squares - np.sum(shared**2, axis=1)
        along = groups @ np.sum(errors * vectors, axis=1)
        explained = along**2 / np.where(own > 1e-9 * squares, own, np.inf)
        best = int(np.argmax(explained))
        total = max(float(np.sum(errors**2)), 1e-300)
        return best, max(1.0 - float(explained[best]) / total, 1e-12)

    @property
    def sigma(self) -> float:
        """Root mean square of the errors that least squares leaves, at least a nanometre, m."""
        errors = fit_positions(self.columns, self.positions).errors
        return max(float(np.sqrt(np.mean(errors**2))), 1e-9)

    def deviance(self, logarithms: Float[np.ndarray, "deviations"]) -> float:
        """Return minus twice the log likelihood of the standard deviation in all directions, m."""
        return self._scored(logarithms, _EYE[None, None])[0]

    def _scored(
        self,
        logarithms: Float[np.ndarray, "deviations"],
        shapes: Float[np.ndarray, "deviations #views 3 3"],
    ) -> tuple[float, Float[np.ndarray, "deviations"]]:
        """Return the deviance of standard deviations with its gradient by their logarithms.

        Args:
            logarithms: of the standard deviations.
            shapes: covariance of the views' errors for a standard deviation of one.
        """
        parts = np.exp(2.0 * logarithms)[:, None, None, None] * shapes
        covariance = self.noise + parts.sum(axis=0)
        # Rendered views may leave nothing across the vectors, where rounding would be negative.
        floor = MIN_VARIANCE + 1e-12 * np.einsum("vii->v", covariance)
        factors = np.linalg.cholesky(covariance + floor[:, None, None] * _EYE)
        whitening = np.linalg.inv(factors)
        whitened = (whitening @ self.equations).reshape(-1, self.equations.shape[2])
        # Of orthogonal factors of the equations the last is what no column explains.
        basis, triangle = np.linalg.qr(whitened)
        errors = triangle[-1, -1] * basis[:, -1].reshape(-1, 3)
        # -2 log L = sum of e^T C^-1 e + log det C, with the covariance C = L L^T of a view. Along a
        # logarithm with A = L^-1 dC L^-T it changes by trace A - (L^-1 e)^T A (L^-1 e).
        changes = 2.0 * whitening @ parts @ whitening.swapaxes(1, 2)
        gradient = np.einsum("kvii->k", changes)
        gradient = gradient - np.einsum("vi,kvij,vj->k", errors, changes, errors)
        deviance = np.sum(errors**2) + 2.0 * np.log(np.einsum("vii->vi", factors)).sum()
        return float(deviance), gradient

    def least_deviance(self, along: Float[np.ndarray, "views"]) -> float:
        """Return what no deviance is below if errors along the optical axis are so large or larger.

        Across the axis the errors are smallest where the positions along it count nothing.

        Args:
            along: standard deviations along the axis, m.
        """
        across = self.columns[:, :2].reshape(-1, self.columns.shape[2])
        target = self.positions[:, :2].ravel()
        errors = target - across @ np.linalg.lstsq(across, target, rcond=1e-9)[0]
        # n log s^2 + |e|^2 / s^2 is least for s^2 = |e|^2 / n.
        variance = max(float(np.mean(errors**2)), 1e-300)
        return len(errors) * (np.log(variance) + 1.0) + 2.0 * float(np.sum(np.log(along)))

    def likelihood(self, vectors: Float[np.ndarray, "views 3"] | None) -> _Likelihood:
        """Return the likeliest errors that are alike in all directions, plus some along vectors."""
        alike = np.broadcast_to(_EYE, self.noise.shape)[None]
        sigma = np.log(self.sigma)
        if vectors is None:
            logarithms, deviance = self._likeliest(np.array([sigma]), alike)
            return _Likelihood(float(np.exp(logarithms[0])), 0.0, deviance)
        shapes = np.concatenate([alike, _outer_products(vectors)[None]])
        size = np.log(float(np.sqrt(np.mean(np.sum(vectors**2, axis=1)))))
        starts = np.array([[sigma, sigma - 1.0 - size], [sigma - 2.0, sigma - size]])
        logarithms, deviance = min(
            (self._likeliest(start, shapes) for start in starts), key=lambda found: found[1]
        )
        sigma, size = np.exp(logarithms).tolist()
        return _Likelihood(sigma, size, deviance)

    def _likeliest(
        self,
        start: Float[np.ndarray, "deviations"],
        shapes: Float[np.ndarray, "deviations #views 3 3"],
    ) -> tuple[Float[np.ndarray, "deviations"], float]:
        """Return the likeliest logarithms near a start, and their deviance."""
        # A bound on both sides would let the first step go as far as either.
        bounds = [(None, MAX_LOGARITHM)] * len(start)
        result = minimize(self._scored, start, (shapes,), "L-BFGS-B", jac=True, bounds=bounds)
        return result.x, float(result.fun)
