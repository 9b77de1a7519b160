"""A solid drawn flat with OpenCV in five views, for tests of the editor."""

from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np

from smartview_jax.calibration import Calibration
from smartview_jax.cameras import Camera, Radial
from smartview_jax.geometry import five_viewpoints, host_matrices
from smartview_jax.modeling import Face, ObjectModel, edges_of_faces

ROLLS = np.array([0.0, 0.2, -0.3, 0.4, -0.1])
"""Of the five viewpoints about their optical axes, rad."""


class DrawnScene(NamedTuple):
    calibration: Calibration
    base_from_tool: np.ndarray
    pictures: list[np.ndarray]
    truth: ObjectModel
    pixels: np.ndarray

    def click(self, view, vertex, rng=None, sigma=0.3):
        """The pixel of a vertex in a view, as a person would click it."""
        noise = 0.0 if rng is None else sigma * rng.standard_normal(2)
        return tuple((self.pixels[view, vertex] + noise).tolist())


def house():
    """A block with a gable roof: ten vertices, seven faces, outward."""
    x, y, wall, ridge = 0.05, 0.035, 0.02, 0.035
    profile = [(0.0, 0.0), (y, 0.0), (y, wall), (y / 2, ridge), (0.0, wall)]
    vertices = np.array([(k * x, *p) for k in (0, 1) for p in profile])
    vertices -= [x / 2, y / 2, 0.0]
    sides = [(k, (k + 1) % 5, 5 + (k + 1) % 5, 5 + k) for k in range(5)]
    faces = tuple(map(Face, [(0, 1, 2, 3, 4)[::-1], (5, 6, 7, 8, 9), *sides]))
    return ObjectModel(vertices, edges_of_faces(faces), faces)


def drawn_scene(width=640, height=480, truth=None):
    """The paper's five viewpoints, steeper than there so that walls are seen."""
    truth = house() if truth is None else truth
    f = 1.6 * width
    lens = Radial(0.05)
    camera = Camera(f, f, width / 2 - 0.5, height / 2 - 0.5, lens, (width, height))
    calibration = Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
    poses = five_viewpoints(np.array([0.0, 0.0, 0.012]), 0.2, ROLLS, step=float(np.deg2rad(28.0)))
    camera_from_world = host_matrices(poses)
    pixels = np.stack(
        [
            np.asarray(
                camera.project(jnp.asarray(truth.vertices @ view[:3, :3].T + view[:3, 3]))[0]
            )
            for view in camera_from_world
        ]
    )
    pictures = [
        draw(truth, view, flat, (width, height))
        for view, flat in zip(camera_from_world, pixels, strict=True)
    ]
    return DrawnScene(calibration, np.linalg.inv(camera_from_world), pictures, truth, pixels)


def draw(model, camera_from_world, pixels, size):
    """Faces towards the camera in grey, by their slope; the far ones first."""
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(60, 90, (30, 40), dtype=np.uint8), size)
    centre = -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]
    for k, face in enumerate(model.faces):
        plane = model.plane(k)
        if (centre - plane.origin) @ plane.normal > 0.0:
            shade = 130 + 90 * abs(plane.normal @ [0.4, 0.5, 0.77])
            corners = np.round(16 * (pixels[list(face.loop)] + 0.0)).astype(np.int32)
            cv2.fillPoly(image, [corners], int(shade), cv2.LINE_AA, 4)
    return cv2.GaussianBlur(image, (0, 0), 0.7)
