"""Compute with rigid transforms as NumPy matrices, without compiling a JAX program."""

import numpy as np
from jaxlie import SE3
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def host_matrices(poses: SE3) -> Float[np.ndarray, "*batch 4 4"]:
    """Return transforms `(*batch)` as 4x4 matrices, NaN where a transform is not finite."""
    numbers = np.asarray(poses.wxyz_xyz)
    matrices = np.full((*numbers.shape[:-1], 4, 4), np.nan)
    finite = np.isfinite(numbers).all(axis=-1)
    if finite.any():
        # SciPy expects the real part of a quaternion last, and raises where one is not finite.
        rotations = Rotation.from_quat(numbers[finite][:, [1, 2, 3, 0]]).as_matrix()
        matrices[finite] = np.eye(4)
        matrices[finite, :3, :3] = rotations
        matrices[finite, :3, 3] = numbers[finite][:, 4:]
    return matrices


def host_transforms(matrices: Float[np.ndarray, "*batch 4 4"]) -> SE3:
    """Return rigid 4x4 matrices as transforms `(*batch)` of NumPy arrays, the inverse conversion.

    A transform is NaN where its matrix is not finite.
    """
    numbers = np.full((*matrices.shape[:-2], 7), np.nan)
    finite = np.isfinite(matrices).all(axis=(-2, -1))
    if finite.any():
        quaternions = Rotation.from_matrix(matrices[finite][:, :3, :3]).as_quat()
        numbers[finite] = np.concatenate(
            [quaternions[:, [3, 0, 1, 2]], matrices[finite][:, :3, 3]], axis=1
        )
    return SE3(numbers)  # pyright: ignore[reportArgumentType]


def host_logarithms(matrices: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """Return the tangents of rigid 4x4 matrices as `SE3.log` does, translation first.

    A tangent is NaN where its matrix is not finite.
    """
    tangents = np.full((*matrices.shape[:-2], 6), np.nan)
    finite = np.isfinite(matrices).all(axis=(-2, -1))
    if finite.any():
        t = matrices[finite][:, :3, 3]
        w = Rotation.from_matrix(matrices[finite][:, :3, :3]).as_rotvec()
        angle = np.linalg.norm(w, axis=1, keepdims=True)
        # The translation t is V v of the tangent (v, w), and with half the angle, h,
        #   V^-1 t = t - w x t / 2 + (1 - h cot h) w x (w x t) / angle^2.
        # The last term is exactly zero for angle zero, whatever it is divided by.
        factor = 1.0 - np.cos(0.5 * angle) / np.sinc(0.5 * angle / np.pi)
        factor /= np.where(angle > 0.0, angle, 1.0) ** 2
        turned = np.cross(w, t)
        tangents[finite] = np.concatenate(
            [t - 0.5 * turned + factor * np.cross(w, turned), w], axis=1
        )
    return tangents
