"""Convert rigid transforms to NumPy matrices without compiling a JAX program."""

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
