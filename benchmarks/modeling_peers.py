"""The same clicks triangulated by OpenCV and by pycolmap, with the cameras known.

OpenCV takes two views at a time: here the first and each other one, averaged. What these programs
do not know is the lens, so pixels are undistorted first, and the errors of the pixels.
"""

import importlib.util
from collections.abc import Callable

import cv2
import numpy as np

import smartview_jax as sv
from smartview_jax.modeling import triangulate_points
from smartview_jax.simulation import six_axis_scene

from .modeling_objects import CLICK_SIGMA, Clicks, arm_clicks


def peer_errors(objects: int) -> dict[str, float]:
    """RMS distance of vertices from the truth, m, by program."""
    scene = six_axis_scene(0)
    camera = scene.calibration.camera
    programs: dict[str, Callable[[Clicks, np.ndarray], np.ndarray]] = {
        "smartview": lambda clicks, _: _smartview(camera, clicks),
        "OpenCV triangulatePoints": _opencv,
    }
    if importlib.util.find_spec("pycolmap") is None:
        print("pycolmap is not installed: pip install pycolmap")
    else:
        programs["pycolmap multi-view"] = _pycolmap
        programs["pycolmap estimate"] = _pycolmap_estimate
    errors: dict[str, list[np.ndarray]] = {name: [] for name in programs}
    for seed in range(objects):
        clicks = arm_clicks(scene, seed, CLICK_SIGMA)
        ideal = undistorted(camera, clicks.pixels)
        for name, program in programs.items():
            errors[name].append(program(clicks, ideal) - clicks.points)
    return {
        name: float(np.sqrt(np.nanmean(np.sum(np.concatenate(parts) ** 2, axis=1))))
        for name, parts in errors.items()
    }


def undistorted(camera: sv.Camera, pixels: np.ndarray) -> np.ndarray:
    """Ideal normalised coordinates by OpenCV."""
    K = np.array([[camera.alpha_u, 0, camera.u0], [0, camera.alpha_v, camera.v0], [0, 0, 1.0]])
    lens = camera.lens
    distortion = np.array([getattr(lens, name) for name in ("k1", "k2", "p1", "p2", "k3")], float)
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    flat = np.nan_to_num(pixels.reshape(-1, 1, 2), nan=500.0)
    ideal = cv2.undistortPointsIter(flat, K, distortion, np.eye(3), np.eye(3), until)
    ideal = ideal.reshape(pixels.shape)
    return np.where(np.isfinite(pixels), ideal, np.nan)


def _smartview(camera: sv.Camera, clicks: Clicks) -> np.ndarray:
    truth = sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
    poses = np.linalg.inv(clicks.camera_from_world)
    return triangulate_points(truth, poses, clicks.pixels, pixel_sigma=CLICK_SIGMA).points


def _opencv(clicks: Clicks, ideal: np.ndarray) -> np.ndarray:
    points = []
    for k in range(ideal.shape[1]):
        first, *others = np.flatnonzero(np.isfinite(ideal[:, k, 0]))
        pairs = [
            cv2.triangulatePoints(
                clicks.camera_from_world[first, :3],
                clicks.camera_from_world[other, :3],
                ideal[first, k],
                ideal[other, k],
            )[:, 0]
            for other in others
        ]
        points.append(np.mean([pair[:3] / pair[3] for pair in pairs], axis=0))
    return np.array(points)


def _pycolmap(clicks: Clicks, ideal: np.ndarray) -> np.ndarray:
    import pycolmap  # pyright: ignore[reportMissingImports]

    points = []
    for k in range(ideal.shape[1]):
        views = np.flatnonzero(np.isfinite(ideal[:, k, 0]))
        rays = np.concatenate([ideal[views, k], np.ones((len(views), 1))], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        found = pycolmap.triangulate_multi_view_point(
            list(clicks.camera_from_world[views, :3]), rays
        )
        points.append(np.full(3, np.nan) if found is None else np.ravel(found))
    return np.array(points)


def _pycolmap_estimate(clicks: Clicks, ideal: np.ndarray) -> np.ndarray:
    """Its robust estimate, with the pixels of an ideal camera of the same focal length."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    camera = pycolmap.Camera(
        model="PINHOLE", width=1920, height=1200, params=[1056.0, 1056.0, 958.0, 587.0]
    )
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = 10.0 * CLICK_SIGMA
    points = []
    for k in range(ideal.shape[1]):
        views = np.flatnonzero(np.isfinite(ideal[:, k, 0]))
        poses = [pycolmap.Rigid3d(clicks.camera_from_world[v, :3]) for v in views]
        pixels = 1056.0 * ideal[views, k] + [958.0, 587.0]
        found = pycolmap.estimate_triangulation(pixels, poses, [camera] * len(views), options)
        points.append(np.full(3, np.nan) if found is None else np.ravel(found["xyz"]))
    return np.array(points)
