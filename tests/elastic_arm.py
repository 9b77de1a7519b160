"""An arm whose joints give way to the weight of its links: NumPy and OpenCV alone."""

import dataclasses
import functools

import cv2
import numpy as np
from fit_scenes import thinned

from smartview_jax.geometry import host_exponentials, host_matrices
from smartview_jax.runtime.array_namespace import to_device
from smartview_jax.simulation import six_axis_scene

D = np.array([0.4, 0.0, 0.0, 0.64, 0.0, 0.115])
A = np.array([0.15, 0.6, 0.12, 0.0, 0.0, 0.0])
ALPHA = np.deg2rad([-90.0, 0.0, -90.0, 90.0, -90.0, 0.0])
THETA = np.deg2rad([0.0, -90.0, 0.0, 0.0, 0.0, 0.0])

MASSES = np.array([0.0, 20.0, 12.0, 8.0, 3.0, 2.0])
"""Mass of each link, kg: of the upper arm at its middle, of the others at their ends."""

COMPLIANCES = np.deg2rad([0.0, 3e-4, 5e-4, 0.0, 1e-3, 0.0])
"""Angle by which each joint gives way, rad per Nm: 0.1 degrees of the shoulder at full reach."""


def frames(joints):
    """The frame before the first joint, and after each link, by Denavit and Hartenberg."""
    poses = [np.broadcast_to(np.eye(4), (len(joints), 4, 4))]
    for k in range(6):
        c, s = np.cos(joints[:, k] + THETA[k]), np.sin(joints[:, k] + THETA[k])
        ca, sa, zero = np.cos(ALPHA[k]), np.sin(ALPHA[k]), np.zeros(len(joints))
        one = zero + 1.0
        rows = [
            [c, -s * ca, s * sa, A[k] * c],
            [s, c * ca, -c * sa, A[k] * s],
            [zero, zero + sa, zero + ca, zero + D[k]],
            [zero, zero, zero, one],
        ]
        poses.append(poses[-1] @ np.moveaxis(np.array(rows), -1, 0))
    return np.array(poses)


def torques(joints):
    """Torque of gravity about each joint, Nm: the slope of the potential energy, by differences."""

    def energy(moved):
        heights = frames(moved)[..., 2, 3]
        middle = heights[1:].copy()
        middle[1] = 0.5 * (heights[1] + heights[2])
        return 9.81 * MASSES @ middle

    step = 1e-5 * np.eye(6)
    return -np.stack([(energy(joints + d) - energy(joints - d)) / 2e-5 for d in step], axis=1)


@functools.cache
def elastic_scene(seed, views, bending=1.0):
    """An `ArmScene` whose arm bends so many times as much as `COMPLIANCES` say, and is exact else.

    It has the joints of the library's own scene; where the arm is then, and its pictures of the
    board, is computed here.
    """
    scene = six_axis_scene(seed, views, 1, error_scale=0.0)
    rng = np.random.default_rng(seed)
    calibration, data = scene.calibration.uncorrected, thinned(scene.data, 7)
    joints = np.asarray(scene.joints)
    noise = host_exponentials(rng.normal(size=(views, 6)) * np.repeat([2e-5, 5e-5], 3))
    actual = frames(joints + bending * COMPLIANCES * torques(joints))[-1] @ noise
    camera_from_tool, base_from_world = (
        host_matrices(pose) for pose in calibration.transforms.values()
    )
    lens = calibration.camera.lens
    matrix = np.array([[1056.0, 0.0, 958.0], [0.0, 1056.0, 587.0], [0.0, 0.0, 1.0]])
    distortion = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    pixels = []
    for pose in camera_from_tool @ np.linalg.inv(actual) @ base_from_world:
        points = np.asarray(data.points[0])
        turn = cv2.Rodrigues(pose[:3, :3])[0]
        pixels.append(cv2.projectPoints(points, turn, pose[:3, 3], matrix, distortion)[0][:, 0])
    pixels = np.array(pixels) + 0.05 * rng.normal(size=np.shape(pixels))
    data = dataclasses.replace(data, pixels=to_device(pixels))
    return dataclasses.replace(scene, data=data, calibration=calibration)
