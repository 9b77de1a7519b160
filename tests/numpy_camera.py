"""The paper's camera in plain numpy: a second hand at the same equations, for comparisons."""

import numpy as np
from scipy.spatial.transform import Rotation


def project_radial(numbers: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels of camera-frame points; `numbers` = alpha_u, alpha_v, u0, v0, k1 (Eqs. 2 and 3)."""
    alpha_u, alpha_v, u0, v0, k1 = numbers
    ideal = points[..., :2] / points[..., 2:]
    radius = np.linalg.norm(ideal, axis=-1, keepdims=True)
    distorted = radius.copy()
    for _ in range(20):
        error = distorted + k1 * distorted**3 - radius
        distorted = distorted - error / (1.0 + 3.0 * k1 * distorted**2)
    plane = ideal * np.where(radius > 0.0, distorted / np.where(radius > 0.0, radius, 1.0), 1.0)
    return plane * [alpha_u, alpha_v] + [u0, v0]


def moved(wxyz_xyz: np.ndarray, tangent: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points `(N, 3)` under a pose turned and shifted from the left by a small tangent."""
    rotation = Rotation.from_rotvec(tangent[3:])
    start = Rotation.from_quat(wxyz_xyz[:4], scalar_first=True)
    return rotation.apply(start.apply(points) + wxyz_xyz[4:]) + tangent[:3]
