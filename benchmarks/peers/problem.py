"""The benchmark's problem in plain NumPy: data on disk, residuals, and an analytic Jacobian.

A camera with five numbers (alpha_u, alpha_v, u0, v0 and k1 in OpenCV's direction) on a hand, two
transforms of six numbers each, and in problems d and e six pose corrections a view under a prior.
Nothing here uses the library, so that peers share no code with it.
"""

import dataclasses
from pathlib import Path

import numpy as np

SIZES = {
    "a": (5, 1000, False),
    "b": (50, 1000, False),
    "c": (500, 1000, False),
    "d": (500, 1000, True),
    "e": (5000, 200, True),
    "f": (5, 100, False),
}
"""Views, points a view, and whether every view has pose corrections; of `f` there are many."""

TRANSLATION, ROTATION, PIXEL = 1e-4, 2e-4, 0.15
"""Standard deviations of the noise, m, rad and px; the priors' too."""

PRIOR = np.repeat([TRANSLATION, ROTATION], 3)
"""Standard deviations of a pose correction."""


@dataclasses.dataclass
class Problem:
    """Arrays as they are on disk; poses are 3 x 4 matrices."""

    points: np.ndarray  # (N, 3) m
    pixels: np.ndarray  # (M, N, 2) px
    tool_from_base: np.ndarray  # (M, 3, 4)
    camera: np.ndarray  # (5,) start
    camera_from_tool: np.ndarray  # (3, 4) start
    base_from_world: np.ndarray  # (3, 4) start
    corrected: bool

    def save(self, path: Path) -> None:
        """Flat little-endian doubles: M, N, corrected, then every array."""
        views, count = self.pixels.shape[:2]
        parts = [np.array([views, count, self.corrected, TRANSLATION, ROTATION, PIXEL])]
        names = [field.name for field in dataclasses.fields(self)][:-1]
        parts += [getattr(self, name).ravel() for name in names]
        np.concatenate(parts).astype("<f8").tofile(path)


def load(path: Path) -> Problem:
    """What `save` wrote."""
    numbers = np.fromfile(path, dtype="<f8")
    views, count, corrected = (int(x) for x in numbers[:3])
    shapes = ((count, 3), (views, count, 2), (views, 3, 4), (5,), (3, 4), (3, 4))
    arrays, at = [], 6
    for shape in shapes:
        size = int(np.prod(shape))
        arrays.append(numbers[at : at + size].reshape(shape))
        at += size
    points, pixels, robot, camera, hand, world = arrays
    return Problem(points, pixels, robot, camera, hand, world, bool(corrected))


def make(views: int, count: int, corrected: bool, seed: int = 0) -> Problem:
    """The paper's camera and distance; every view sees every point."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([0.022 * (rng.random((count, 2)) - 0.5), np.zeros(count)])
    truth = np.array([2133.0, 2140.0, 322.0, 238.0, -0.2])
    camera_from_tool = _pose(np.array([0.02, -0.03, -0.08]), np.array([0.05, -0.02, 0.4]))
    base_from_world = _pose(np.array([0.5, 0.1, 0.05]), np.array([0.02, 0.01, 0.3]))
    turns = np.column_stack([rng.uniform(-0.6, 0.6, (views, 2)), rng.uniform(-3.0, 3.0, views)])
    flip = np.diag([1.0, -1.0, -1.0])
    camera_from_world = np.empty((views, 3, 4))
    for k, turn in enumerate(turns):
        camera_from_world[k, :, :3] = exp(turn) @ flip
        camera_from_world[k, :, 3] = (*rng.uniform(-0.004, 0.004, 2), rng.uniform(0.19, 0.23))
    pixels = project(truth, camera_from_world, points)[0]
    pixels = pixels + PIXEL * rng.normal(size=pixels.shape)
    tool_from_base = np.stack(
        [
            compose(compose(inverse(camera_from_tool), pose), inverse(base_from_world))
            for pose in camera_from_world
        ]
    )
    if corrected:
        for k in range(views):
            shift, turn = TRANSLATION * rng.normal(size=3), ROTATION * rng.normal(size=3)
            tool_from_base[k] = compose(_pose(shift, turn), tool_from_base[k])
    start = truth * np.array([1.01, 0.99, 1.0, 1.0, 0.0]) + np.array([0.0, 0.0, 3.0, -3.0, 0.0])
    nudge = 2e-3 * rng.normal(size=(2, 6))
    return Problem(
        points,
        pixels,
        tool_from_base,
        start,
        compose(_pose(nudge[0, :3], nudge[0, 3:]), camera_from_tool),
        compose(_pose(nudge[1, :3], nudge[1, 3:]), base_from_world),
        corrected,
    )


def project(
    camera: np.ndarray, pose: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels `(..., N, 2)`, and their derivatives by the camera (5) and by a twist (6)."""
    alpha_u, alpha_v, u0, v0, k1 = camera
    p = points @ np.swapaxes(pose[..., :3], -1, -2) + pose[..., None, :, 3]
    inverse_depth = 1.0 / p[..., 2]
    x, y = p[..., 0] * inverse_depth, p[..., 1] * inverse_depth
    square = x * x + y * y
    ratio = 1.0 + k1 * square
    pixels = np.stack([alpha_u * x * ratio + u0, alpha_v * y * ratio + v0], axis=-1)
    by_camera = np.zeros((*pixels.shape, 5))
    by_camera[..., 0, 0], by_camera[..., 1, 1] = x * ratio, y * ratio
    by_camera[..., 0, 2] = by_camera[..., 1, 3] = 1.0
    by_camera[..., 0, 4], by_camera[..., 1, 4] = alpha_u * x * square, alpha_v * y * square
    by_x = np.stack([alpha_u * (ratio + 2.0 * k1 * x * x), alpha_v * 2.0 * k1 * x * y], axis=-1)
    by_y = np.stack([alpha_u * 2.0 * k1 * x * y, alpha_v * (ratio + 2.0 * k1 * y * y)], axis=-1)
    x, y, rho = x[..., None], y[..., None], inverse_depth[..., None]
    radial = x * by_x + y * by_y
    by_twist = np.stack(
        [
            rho * by_x,
            rho * by_y,
            -rho * radial,
            -y * radial - by_y,
            by_x + x * radial,
            x * by_y - y * by_x,
        ],
        axis=-1,
    )
    return pixels, by_camera, by_twist


class View:
    """Residuals of one view, whitened, and their Jacobian by camera (5) and both steps (6 + 6).

    A step adds to the translation, and turns by `exp(step)` from the left. In problems with pose
    corrections the view's own, a twist, follows the steps.
    """

    def __init__(self, problem: Problem, k: int):
        self.problem, self.k = problem, k

    def __call__(
        self,
        camera: np.ndarray,
        hand: np.ndarray,
        world: np.ndarray,
        correction: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        data = self.problem
        camera_from_tool = moved(data.camera_from_tool, hand)
        base_from_world = moved(data.base_from_world, world)
        robot = data.tool_from_base[self.k]
        if correction is not None:
            robot = compose(twist_exp(correction), robot)
        camera_from_base = compose(camera_from_tool, robot)
        pose = compose(camera_from_base, base_from_world)
        pixels, by_camera, by_twist = project(camera, pose, data.points)
        by_hand = by_twist @ _twist_of_step(camera_from_tool, hand)
        by_world = by_twist @ (adjoint(camera_from_base) @ _twist_of_step(base_from_world, world))
        columns = [by_camera, by_hand, by_world]
        if correction is not None:
            columns.append(by_twist @ (adjoint(camera_from_tool) @ twist_jacobian(correction)))
        jacobian = -np.concatenate(columns, axis=-1) / PIXEL
        residual = (data.pixels[self.k] - pixels) / PIXEL
        return residual.ravel(), jacobian.reshape(residual.size, -1)


def columns_of(jacobian: np.ndarray) -> list[np.ndarray]:
    """A view's Jacobian by block: camera, both steps, and the correction where there is one."""
    return np.split(jacobian, [k for k in (5, 11, 17) if k < jacobian.shape[1]], axis=1)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`a @ b` of two 3 x 4 transforms."""
    return np.column_stack([a[:, :3] @ b[:, :3], a[:, :3] @ b[:, 3] + a[:, 3]])


def inverse(a: np.ndarray) -> np.ndarray:
    """Of a 3 x 4 transform."""
    return np.column_stack([a[:, :3].T, -a[:, :3].T @ a[:, 3]])


def exp(turn: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = np.linalg.norm(turn)
    K = cross(turn)
    if angle < 1e-8:
        return np.eye(3) + K + 0.5 * K @ K
    return np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / angle**2 * K @ K


def left_jacobian(turn: np.ndarray) -> np.ndarray:
    """Of `exp`."""
    angle = np.linalg.norm(turn)
    K = cross(turn)
    if angle < 1e-5:
        return np.eye(3) + 0.5 * K + K @ K / 6.0
    return (
        np.eye(3)
        + (1.0 - np.cos(angle)) / angle**2 * K
        + (angle - np.sin(angle)) / angle**3 * K @ K
    )


def twist_exp(twist: np.ndarray) -> np.ndarray:
    """The transform of a twist, translation first."""
    return _pose(left_jacobian(twist[3:]) @ twist[:3], twist[3:])


def twist_jacobian(twist: np.ndarray) -> np.ndarray:
    """Left Jacobian of `twist_exp`, by the series: for corrections, which are small."""
    K = cross(twist[3:])
    ad = np.block([[K, cross(twist[:3])], [np.zeros((3, 3)), K]])
    return np.eye(6) + ad / 2.0 + ad @ ad / 6.0 + ad @ ad @ ad / 24.0


def cross(v: np.ndarray) -> np.ndarray:
    """The matrix of the cross product."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def adjoint(a: np.ndarray) -> np.ndarray:
    """Of a 3 x 4 transform, on twists with the translation first."""
    R, t = a[:, :3], a[:, 3]
    return np.block([[R, cross(t) @ R], [np.zeros((3, 3)), R]])


def moved(start: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A transform a step away from where it started."""
    return np.column_stack([exp(step[3:]) @ start[:, :3], start[:, 3] + step[:3]])


def _twist_of_step(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    J = left_jacobian(step[3:])
    return np.block([[np.eye(3), cross(pose[:, 3]) @ J], [np.zeros((3, 3)), J]])


def _pose(shift: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.column_stack([exp(turn), shift])
