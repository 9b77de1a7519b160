"""Random convex polyhedra, clicked in five views, and the stated uncertainty of their vertices.

A new rig is drawn for every object: with the calibration known, or estimated by a joint fit on
other views of the same simulated rig. Judged is the normalised error of all vertices of an object
together, which knows that the calibration's errors are common to them.
"""

from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from rich.progress import track
from scipy.spatial import ConvexHull

import smartview_jax as sv
from smartview_jax.evaluation import ConsistencyStatistic, mean_nees, nees
from smartview_jax.geometry import five_viewpoints, host_matrices
from smartview_jax.modeling import RefinedFeatures, TriangulatedPoints, triangulate_points
from smartview_jax.robots import six_axes, solve_joints_iteratively
from smartview_jax.simulation import (
    ArmScene,
    paper_calibration,
    paper_points,
    random_scene,
    reported_poses,
    six_axis_scene,
)

CLICK_SIGMA = 0.3
"""Standard deviation of the clicks, px."""

NOISE = sv.Noise(pixel=0.15, translation=1e-4, rotation=2e-4)
"""Of the paper's rig where its calibration is estimated."""

VIEWS, ROLL = 25, np.array([0.3, 0.0, -0.2, 0.5, 1.0])
"""Views that the rig is calibrated with; rolls of the five views of an object, rad."""


class Clicks(NamedTuple):
    """A polyhedron and the clicks on its vertices.

    Attributes:
        points: true vertices, m.
        poses: what the robot reported in the five views.
        camera_from_world: true extrinsics.
        pixels: clicks; NaN where a vertex is hidden.
        edges: pairs of vertices.
    """

    points: np.ndarray
    poses: np.ndarray
    camera_from_world: np.ndarray
    pixels: np.ndarray
    edges: np.ndarray


def polyhedron(rng: np.random.Generator, centre: np.ndarray, radius: float) -> ConvexHull:
    """The hull of 8 to 24 random points on a sphere."""
    directions = rng.standard_normal((rng.integers(8, 25), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return ConvexHull(centre + radius * directions)


def seen_vertices(hull: ConvexHull, camera_centres: np.ndarray) -> np.ndarray:
    """Whether each camera sees a vertex: some face of it is turned towards the camera."""
    faces = hull.equations[:, :3] @ camera_centres.T + hull.equations[:, 3:] > 0.0
    seen = np.zeros((len(camera_centres), len(hull.points)), dtype=bool)
    for corners, towards in zip(hull.simplices, faces, strict=True):
        seen[np.ix_(towards, corners)] = True
    return seen


def click(
    truth: sv.Calibration,
    actual: SE3,
    reported: np.ndarray,
    hull: ConvexHull,
    rng: np.random.Generator,
    sigma: float = CLICK_SIGMA,
) -> Clicks:
    """Clicks on a polyhedron; only vertices that two views see."""
    camera_from_world = host_matrices(truth.uncorrected.camera_from_world(actual))
    centres = np.linalg.inv(camera_from_world)[:, :3, 3]
    pixels = np.array(truth.uncorrected.project(actual, hull.points)[0])
    pixels += sigma * rng.standard_normal(pixels.shape)
    inside = ((pixels > 0.0) & (pixels < np.array(truth.camera.image_size) - 1.0)).all(axis=-1)
    seen = seen_vertices(hull, centres) & inside
    kept = np.flatnonzero(seen.sum(axis=0) >= 2)
    place = {int(old): new for new, old in enumerate(kept)}
    pairs = {
        tuple(sorted(map(int, pair))) for s in hull.simplices for pair in (s[:2], s[1:], s[::2])
    }
    edges = [(place[i], place[j]) for i, j in sorted(pairs) if i in place and j in place]
    return Clicks(
        hull.points[kept],
        reported,
        camera_from_world,
        np.where(seen[..., None], pixels, np.nan)[:, kept],
        np.array(edges).reshape(-1, 2),
    )


def edge_errors(found: TriangulatedPoints | RefinedFeatures, clicks: Clicks) -> np.ndarray:
    """Errors of the lengths of all edges, m; edges at vertices that failed are left out."""
    lengths = [
        np.linalg.norm(np.diff(points[clicks.edges], axis=1)[:, 0], axis=1)
        for points in (found.points, clicks.points)
    ]
    difference = lengths[0] - lengths[1]
    return difference[np.isfinite(difference)]


def paper_clicks(seed: int, noisy: bool) -> Clicks:
    """A polyhedron of 24 mm before the paper's camera."""
    rng, truth = np.random.default_rng((seed, 5)), paper_calibration()
    centre = paper_points().mean(axis=0)
    actual = truth.command_for(five_viewpoints(centre, 0.2, ROLL))
    reported = actual
    if noisy:
        reported = reported_poses(actual, rng, NOISE.translation, NOISE.rotation)
    return click(truth, actual, host_matrices(reported), polyhedron(rng, centre, 0.012), rng)


def nees_of_known(objects: int) -> tuple[ConsistencyStatistic, float]:
    """The mean NEES of single vertices with the rig known, and the RMS error of edges, m."""
    squares, edges = [], []
    for seed in range(objects):
        clicks = paper_clicks(seed, noisy=False)
        triangulated = triangulate_points(
            paper_calibration(), clicks.poses, clicks.pixels, pixel_sigma=CLICK_SIGMA
        )
        ok = triangulated.ok
        squares.append(
            nees(triangulated.points[ok] - clicks.points[ok], triangulated.picture_covariance[ok])
        )
        edges.append(edge_errors(triangulated, clicks))
    return mean_nees(np.concatenate(squares), 3), _rms(edges)


def nees_of_estimated(objects: int) -> tuple[ConsistencyStatistic, float]:
    """The mean NEES of a vertex with the rig of a joint fit, and the RMS error of edges, m."""
    square, coordinates, edges = 0.0, 0, []
    for seed in track(range(objects), "joint fits", disable=objects < 10):
        board = paper_points((0.0, 0.02))[::2]
        rig = random_scene(seed, VIEWS, board, pixel_noise=NOISE.pixel,
                           translation_noise=NOISE.translation,
                           rotation_noise=NOISE.rotation)  # fmt: skip
        fit = sv.fit_joint(rig.data, paper_calibration(), noise="estimated", field=None)
        clicks = paper_clicks(seed, noisy=True)
        triangulated = triangulate_points(
            fit.calibration, clicks.poses, clicks.pixels, covariance=fit, pixel_sigma=CLICK_SIGMA
        )
        ok = np.flatnonzero(triangulated.ok)
        error = (triangulated.points - clicks.points)[ok].ravel()
        square += error @ np.linalg.solve(triangulated.joint_covariance(ok.tolist()), error)
        coordinates += len(error)
        edges.append(edge_errors(triangulated, clicks))
    # As many runs of three numbers as there were vertices: their sum is what is chi-square.
    vertices = coordinates // 3
    return mean_nees(np.full(vertices, square / vertices), 3), _rms(edges)


class ArmErrors(NamedTuple):
    """RMS errors of edges on the simulated 6R arm, m, by calibration."""

    exact: float
    staged: float
    joint: float
    refined: float


def arm_clicks(scene: ArmScene, seed: int, sigma: float) -> Clicks:
    """A polyhedron of 80 mm before the camera of an arm with errors of its links."""
    rng, truth, arm = np.random.default_rng((seed, 6)), scene.calibration, six_axes()
    centre = np.array([0.165, 0.12, 0.03])
    wanted = five_viewpoints(centre, 0.5, ROLL)
    joints, reached = solve_joints_iteratively(
        arm, truth.command_for(wanted, corrected=False), scene.joints[:1].repeat(5, axis=0)
    )
    assert bool(reached.all())
    error = truth.robot_error
    assert error is not None
    actual = error.actual_pose(arm.command(joints))
    reported = host_matrices(arm.base_from_tool(joints))
    return click(truth, actual, reported, polyhedron(rng, centre, 0.04), rng, sigma)


def arm_errors(rigs: int, objects: int) -> dict[float, ArmErrors]:
    """Errors of edges by calibration of the same pictures, for clicks of 0.3 px and without error.

    The latter is the calibration's own share. "refined" also estimates the calibration, under its
    prior, from the object's pictures.
    """
    errors = {sigma: {name: [] for name in ArmErrors._fields} for sigma in (CLICK_SIGMA, 0.0)}
    for seed in track(range(rigs), "arms", disable=rigs < 3):
        scene = six_axis_scene(seed)
        staged = sv.fit_staged(scene.data, lens="opencv4")
        joint = sv.fit_joint(scene.data, staged.calibration)
        for k, sigma in ((k, sigma) for k in range(objects) for sigma in errors):
            clicks = arm_clicks(scene, 100 * seed + k, sigma)
            answers = {
                "exact": _with_known_cameras(scene.calibration.camera, clicks),
                "staged": _triangulated(staged.calibration, clicks),
                "joint": _triangulated(joint.calibration, clicks),
                "refined": sv.modeling.refine(
                    None,
                    sv.modeling.ModelObservations(
                        joint.calibration, clicks.poses, clicks.pixels, pixel_sigma=CLICK_SIGMA
                    ),
                    free="calibration",
                    covariance=joint,
                ),
            }
            for name, answer in answers.items():
                errors[sigma][name].append(edge_errors(answer, clicks))
    return {
        sigma: ArmErrors(*(_rms(parts[name]) for name in ArmErrors._fields))
        for sigma, parts in errors.items()
    }


def _triangulated(calibration: sv.Calibration, clicks: Clicks) -> TriangulatedPoints:
    return triangulate_points(calibration, clicks.poses, clicks.pixels, pixel_sigma=CLICK_SIGMA)


def _with_known_cameras(camera: sv.Camera, clicks: Clicks) -> TriangulatedPoints:
    """With the true camera at its true poses: what the clicks alone leave of error."""
    truth = sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
    known = clicks._replace(poses=np.linalg.inv(clicks.camera_from_world))
    return _triangulated(truth, known)


def _rms(parts: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
