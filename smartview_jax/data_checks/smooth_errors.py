"""Fit a linear model to closure errors that are alike in poses near each other.

The errors of the views are white noise plus a Gaussian process over the robot's poses. Its size and
reach are those that make the errors likeliest.

References:
    Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.7.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..geometry import host_adjoints, host_logarithms
from .closure import Poses
from .misfit_evidence import error_variances, in_parts
from .transform_fit import fit_transforms

REACHES = (0.5, 1.0, 3.0)
"""Reaches of the robot's errors that are tried, in position and in rotation, over the root mean
square difference of the robot's poses."""

RATIOS = (0.0, 1.0, 10.0, 100.0, 1e4)
"""Variances of the robot's errors that are tried, over the variance of the white noise."""


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


def pose_kernels(mount_from_holder: Poses) -> Kernels:
    """Return kernels of several reaches over the robot's poses."""
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


class ViewErrors(NamedTuple):
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
    ) -> "ViewErrors":
        """Return the errors at the mount or at the target, where the model leaves white noise."""
        frames = cls.at_both_ends(at_mount, mount_from_world)
        return min(frames, key=lambda errors: errors.white(model).likelihood)

    @classmethod
    def at_both_ends(
        cls, at_mount: Float[np.ndarray, "views 6"], mount_from_world: Poses
    ) -> tuple["ViewErrors", "ViewErrors"]:
        """Return the errors at the mount and at the target."""
        eye = np.tile(np.eye(6), (len(at_mount), 1, 1))
        to_target = host_adjoints(np.linalg.inv(mount_from_world))
        return cls(at_mount, eye), cls((to_target @ at_mount[..., None])[..., 0], to_target)

    def white(self, model: Float[np.ndarray, "views 6 numbers"]) -> "LinearFit":
        """Return the fit of a model to errors that are white noise."""
        return _fitted(self.values, self.change @ model, _Process.white(len(model)))

    def left_over(
        self, model: Float[np.ndarray, "views 6 numbers"], fit: "LinearFit"
    ) -> Float[np.ndarray, "views 6"]:
        """Return the errors that a fit of a model leaves over, m and rad."""
        return self.values - (self.change @ model) @ fit.numbers

    def likeliest(
        self, model: Float[np.ndarray, "views 6 numbers"], kernels: Kernels
    ) -> "LinearFit":
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


def by_transforms(mount_from_holder: Poses) -> Float[np.ndarray, "views 6 12"]:
    """Return the derivatives of closure errors at the mount by twists of both transforms."""
    eye = np.broadcast_to(np.eye(6), (len(mount_from_holder), 6, 6))
    return np.concatenate([eye, host_adjoints(mount_from_holder)], axis=2)


def errors_of_transforms(mount_from_holder: Poses, camera_from_world: Poses) -> np.ndarray:
    """Return the errors that the likeliest transforms leave over, `(views, 6)`, m and rad.

    Both poses are finite; see `left_over_errors`.
    """
    fit = fit_transforms(mount_from_holder, camera_from_world)
    mount_from_world = mount_from_holder @ fit.holder_from_world
    return left_over_errors(fit.closure, by_transforms(mount_from_holder), mount_from_world)[0]


def left_over_errors(
    closure: Poses, model: Float[np.ndarray, "views 6 numbers"], mount_from_world: Poses
) -> tuple[Float[np.ndarray, "views 6"], Float[np.ndarray, "numbers"]]:
    """Return the errors that the likeliest numbers of a model leave over, and the numbers.

    The errors are at the mount or at the target, where they are more like white noise: next to an
    arm's base, small rotations of a far hand are large translations.

    Args:
        closure: closure error of each view.
        model: derivatives of the closure errors at the mount by the numbers.
        mount_from_world: the pose of the target in the mount's frame in each view.
    """
    frames = ViewErrors.at_both_ends(host_logarithms(closure), mount_from_world)
    fits = ((errors, errors.white(model)) for errors in frames)
    errors, fit = min(fits, key=lambda entry: entry[1].likelihood)
    return errors.left_over(model, fit), fit.numbers


class LinearFit(NamedTuple):
    """A linear model of the closure errors.

    Attributes:
        numbers: its numbers, translation in m and rotation in rad.
        likelihood: minus twice the logarithm of its likelihood, up to a constant.
        error_count: number of errors, six for each view.
    """

    numbers: Float[np.ndarray, "numbers"]
    likelihood: float
    error_count: int


def _fitted(
    errors: Float[np.ndarray, "views 6"],
    model: Float[np.ndarray, "views 6 numbers"],
    process: _Process,
) -> LinearFit:
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
    solution, variances = np.zeros(columns), error_variances(in_parts(independent))
    for _ in range(3):
        weights = np.repeat(1.0 / variances, 3)
        gram, right = np.tensordot(weights, products, 1), weights @ sums
        solution = np.linalg.lstsq(gram, right, rcond=1e-12)[0]
        variances = error_variances(in_parts(independent - design @ solution))
    likelihood = 3.0 * len(errors) * np.log(variances).sum() + 3.0 * np.log1p(process.sizes).sum()
    return LinearFit(solution / lengths, float(likelihood), errors.size)
