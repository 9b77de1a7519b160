"""Compute the expected gain in information of candidate views of objects that were found.

A gain is in nats. It has two parts: the expected log-likelihood ratio between each hypothesis and
its rivals (one rival being that there is no object at all), and half the logarithm by which the
covariance of the grasp shrinks. Parts of an object that known surfaces or other objects occlude in
a view do not count there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...calibration import Calibration
from ...cameras import Camera
from ...engine import Noise
from ...features import SMOOTHED_LENGTH, scaled_camera
from ...geometry import host_adjoints, host_cross_matrices, host_matrices, host_transformed
from ...modeling import ObjectModel
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled_optimised
from ...runtime.padding import in_batches
from ..edges import (
    INDEPENDENT_LENGTH,
    Wireframe,
    centre_in_object,
    pose_jacobians,
    predict_view,
    with_outline,
)
from ..judging import DEFAULT_OPTIONS, Localization
from .occluders import Occluder, hidden_in_views, leading, occluders_around

SAME_EDGE_DISTANCE, SAME_EDGE_COSINE = 4.0, 0.9
"""Distance, px, and cosine of directions within which edges of two hypotheses coincide."""

FOUND, CHANCE = DEFAULT_OPTIONS.found_probability, DEFAULT_OPTIONS.chance_probability
"""Probabilities of an edge point where a piece of an edge is, and where there is clutter."""

ENOUGH_MARGIN = 3.0 * DEFAULT_OPTIONS.min_margin
"""Log-likelihood ratio above which a rival counts as ruled out."""

MAX_RIVALS = 6
"""Largest number of rivals that are considered for each object."""

POSES_PER_BATCH = 64
"""Number of poses predicted at once: one compiled program serves any number."""


class _Predicted(NamedTuple):
    """The visible edges of one hypothesis in all candidate views, and their information.

    Attributes:
        samples: px.
        directions: unit directions of the edges.
        visible_px: length of each sample's part of its edge; zero where it is not visible.
        information: Fisher information on the pose's tangent.
    """

    samples: Float[np.ndarray, "views S 2"]
    directions: Float[np.ndarray, "views S 2"]
    visible_px: Float[np.ndarray, "views S"]
    information: Float[np.ndarray, "views 6 6"]


class _Candidates(NamedTuple):
    """Candidate views of one object.

    Attributes:
        calibration: includes the camera.
        camera_from_world: extrinsics of the views.
        occluders: surfaces that may occlude the object.
    """

    calibration: Calibration
    camera_from_world: Float[np.ndarray, "views 4 4"]
    occluders: list[Occluder]


class ViewGains:
    """The expected gains of candidate views."""

    def __init__(
        self,
        objects: Sequence[Localization],
        calibration: Calibration,
        candidates: Float[np.ndarray, "views 4 4"],
        noise: Noise | None,
        models: Sequence[ObjectModel],
        neighbours: Sequence[Localization],
        triangles: Float[np.ndarray, "triangles 3 3"],
    ):
        count = len(candidates)
        self.discrimination, shrinkage = np.zeros(count), np.zeros(count)
        self.std_before, self.std_after = 0.0, np.zeros(count)
        self.visible = np.zeros(count, dtype=bool)
        self.rivals, self.count = 0, len(objects)
        self.is_open = any(obj.verdict.decision == "open" for obj in objects)
        pose_noise = noise_at_camera(noise, calibration, candidates)
        others = leading([*neighbours, *objects])
        for obj in objects:
            views = _Candidates(calibration, candidates, occluders_around(obj, others, triangles))
            prediction = _predicted(obj.model, obj.world_from_object, views, obj)
            self.visible |= prediction.visible_px.sum(axis=1) > 0.0
            before, after = _grasp_covariances(obj, prediction, candidates, pose_noise)
            shrinkage += 0.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1])
            self.std_before = max(self.std_before, _position_std(before[None])[0])
            self.std_after = np.maximum(self.std_after, _position_std(after))
            needed = max(ENOUGH_MARGIN - obj.verdict.evidence.log_likelihood, 0.0)
            gains = [np.minimum(_against_nothing(prediction), needed)]
            for rival in obj.rivals[:MAX_RIVALS]:
                if rival.model != obj.model_index and rival.model >= len(models):
                    continue
                margin = obj.verdict.evidence.log_odds - rival.log_odds
                model = obj.model if rival.model == obj.model_index else models[rival.model]
                other = _predicted(model, rival.world_from_object, views, obj)
                needed = max(ENOUGH_MARGIN - margin, 0.0)
                self.rivals += needed > 0.0
                gains.append(np.minimum(_difference(prediction, other), needed))
            self.discrimination += np.sum(gains, axis=0)
        self.total = np.where(self.visible, self.discrimination + shrinkage, -np.inf)

    def reason(self, best: int, paper: int | None) -> str:
        """Return the reason for a view as a clause, compared with the paper's view, if any."""
        after = 1e3 * self.std_after[best]
        before = 1e3 * self.std_before
        error = f"the position error (std) goes from {before:.3g} to {after:.3g} mm"
        return f"{self._expected_gain(best)}; {error}; {self._paper_clause(best, paper)}"

    def _expected_gain(self, best: int) -> str:
        """Return in words what a view should reveal about the objects' presence."""
        # As odds, a log-likelihood ratio is easier to read: 2.3 is ten to one.
        odds = 10.0 ** round(float(self.discrimination[best]) / np.log(10.0), 1)
        expected = f"(expected odds {odds:.2g} : 1)"
        is_one = self.count == 1
        objects, are = ("the object", "is") if is_one else ("the objects", "are")
        if self.rivals:
            rivals = "rival" if self.rivals == 1 else "rivals"
            return f"it separates {objects} from {self.rivals} remaining {rivals} {expected}"
        if odds > 1.0 and self.is_open:
            return f"it decides whether {objects} {are} there {expected}"
        if odds > 1.0:
            return f"it makes {objects} more certain {expected}"
        # Open for lack of edges or views, although no odds are left to gain.
        if self.is_open:
            return (
                f"{objects} {are} still open, and the view shows {'it' if is_one else 'them'} again"
            )
        return f"{objects} {are} certain already"

    def _paper_clause(self, best: int, paper: int | None) -> str:
        """Return in words the gain of the paper's view instead."""
        if paper is None:
            return "the view along the normal of the top surface is out of reach"
        if paper == best:
            return "it is the paper's view, along the normal of the top surface"
        part = max(float(self.total[paper] / max(self.total[best], 1e-12)), 0.0)
        return (
            f"the paper's view, along the normal of the top surface, would gain {part:.0%} as much"
        )


def _position_std(covariances: Float[np.ndarray, "views 6 6"]) -> Float[np.ndarray, "views"]:
    """Return the standard deviation of the position in its worst direction."""
    return np.sqrt(np.linalg.eigvalsh(covariances[:, :3, :3])[:, -1])


def _grasp_covariances(
    obj: Localization,
    prediction: _Predicted,
    candidates: Float[np.ndarray, "views 4 4"],
    pose_noise: Float[np.ndarray, "views 6 6"] | None,
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "views 6 6"]]:
    """Return the covariance of the object at the point of the grasp, now and after each view.

    Errors of calibration and model remain; errors of the pictures shrink.
    """
    refined = obj.refined
    fixed = refined.calibration + refined.model
    information = prediction.information
    if pose_noise is not None:
        information = _with_view_noise(information, obj.world_from_object, candidates, pose_noise)
    weight = np.linalg.inv(refined.pictures)
    after = np.linalg.inv(weight + information) + fixed
    # The point between the fingers in the first grasp, or the middle of the object.
    grasps, vertices = obj.model.grasps, obj.model.vertices
    point = grasps[0].object_from_tool[:3, 3] if grasps else vertices.mean(axis=0)
    shift = np.eye(6)
    # A tangent (v, w) moves the point by v + w x p.
    shift[:3, 3:] = -host_cross_matrices(point)
    return shift @ refined.covariance @ shift.T, shift @ after @ shift.T


def noise_at_camera(
    noise: Noise | None, calibration: Calibration, candidates: Float[np.ndarray, "views 4 4"]
) -> Float[np.ndarray, "views 6 6"] | None:
    """Return the covariance of the twist of each camera pose by the robot's noise, m and rad.

    The twist is in the camera frame. None for exact poses, and if nothing is known of them.
    """
    if noise is None or not np.isfinite([noise.translation, noise.rotation]).all():
        return None
    camera_from_mount, holder_from_world = (
        host_matrices(pose) for pose in calibration.transforms.values()
    )
    if calibration.mount == "eye_in_hand":
        camera_from_base = candidates @ np.linalg.inv(holder_from_world)
        camera_from_tool = np.broadcast_to(camera_from_mount, candidates.shape)
    else:
        camera_from_base = np.broadcast_to(camera_from_mount, candidates.shape)
        camera_from_tool = candidates @ np.linalg.inv(holder_from_world)
    tool_from_base = np.linalg.inv(camera_from_tool) @ camera_from_base
    to_camera = host_adjoints(camera_from_tool)
    covariances = noise.pose_covariances(tool_from_base[:, :3, :3])
    return to_camera @ covariances @ to_camera.swapaxes(1, 2)


def _with_view_noise(
    information: Float[np.ndarray, "views 6 6"],
    pose: Float[np.ndarray, "4 4"],
    candidates: Float[np.ndarray, "views 4 4"],
    pose_noise: Float[np.ndarray, "views 6 6"],
) -> Float[np.ndarray, "views 6 6"]:
    """Return the information of views whose camera poses err.

    Args:
        information: of views with exact poses.
        pose: of the object in the world.
        candidates: extrinsics of the views.
        pose_noise: covariance of their twists in the camera frame.
    """
    # The camera's twist as a twist of the object: Q = Ad S Ad^T; (I^-1 + Q)^-1 = I (1 + Q I)^-1.
    adjoint = host_adjoints(np.linalg.inv(candidates @ pose))
    Q = adjoint @ pose_noise @ adjoint.swapaxes(1, 2)
    return information @ np.linalg.inv(np.eye(6) + Q @ information)


def _against_nothing(prediction: _Predicted) -> Float[np.ndarray, "views"]:
    """Return the expected log-likelihood ratio of the visible edges to an empty scene."""
    return (
        prediction.visible_px.sum(axis=1)
        / INDEPENDENT_LENGTH
        * _information_of_piece(FOUND, CHANCE)
    )


def _information_of_piece(p: float, q: float) -> float:
    """Return the expected log-likelihood ratio of probability p to q, if p is true."""
    return float(p * np.log(p / q) + (1.0 - p) * np.log((1.0 - p) / (1.0 - q)))


def _difference(first: _Predicted, second: _Predicted) -> Float[np.ndarray, "views"]:
    """Return the expected log-likelihood ratio of a hypothesis to another, if the first is true.

    Edges that both predict alike do not count. Edges that only the first predicts are found; edges
    that only the second predicts are found by chance.
    """
    only_first, only_second = (
        np.where(_alike(a, b), 0.0, a.visible_px).sum(axis=1) / INDEPENDENT_LENGTH
        for a, b in ((first, second), (second, first))
    )
    found_first = only_first * _information_of_piece(FOUND, CHANCE)
    return found_first + only_second * _information_of_piece(CHANCE, FOUND)


def _alike(first: _Predicted, second: _Predicted) -> Bool[np.ndarray, "views S"]:
    """Return which samples of the first lie on edges of the second with the same direction."""
    alike = np.zeros(first.visible_px.shape, dtype=bool)
    for view in range(len(alike)):
        visible = second.visible_px[view] > 0.0
        gap = first.samples[view][:, None] - second.samples[view][visible][None]
        d = second.directions[view][visible]
        across = np.abs(gap[..., 0] * d[:, 1] - gap[..., 1] * d[:, 0])
        along = np.abs((gap * d).sum(axis=2))
        parallel = np.abs(first.directions[view] @ d.T) > SAME_EDGE_COSINE
        near = (across < SAME_EDGE_DISTANCE) & (along < second.visible_px[view][visible] + 1.0)
        alike[view] = (near & parallel).any(axis=1)
    return alike


def _predicted(
    model: ObjectModel,
    pose: Float[np.ndarray, "4 4"],
    views: _Candidates,
    obj: Localization,
) -> _Predicted:
    """Return the visible edges of a hypothesis in all candidate views."""
    # The noise was measured at the scale at which the pictures were searched.
    camera, wireframe = scaled_camera(views.calibration.camera, obj.scale), Wireframe.of(model)
    sigma = float(obj.refined.edge_sigma)
    point_sigma = float(np.median(obj.refined.lines.scatter[obj.refined.lines.measured]))
    sigmas = to_device(np.array([point_sigma, sigma]))
    in_world = host_transformed(pose, np.asarray(wireframe.samples))

    def of_batch(poses: Float[Array, "views 4 4"]) -> tuple[Array, ...]:
        camera_from_world = np.asarray(poses)
        centres = np.linalg.inv(camera_from_world)[:, :3, 3]
        hidden = to_device(hidden_in_views(views.occluders, centres, in_world))
        camera_from_object = to_device(camera_from_world @ pose)
        return _predict_edges(wireframe, camera, camera_from_object, hidden, sigmas)

    return _Predicted(*in_batches(of_batch, views.camera_from_world, POSES_PER_BATCH))


@compiled_optimised
def _predict_edges(
    wireframe: Wireframe,
    camera: Camera,
    camera_from_object: Float[Array, "views 4 4"],
    hidden: Bool[Array, "views S"],
    sigmas: Float[Array, "2"],
) -> tuple[Array, Array, Array, Array]:
    """Return the fields of `_Predicted`, given the noise of edge points and of whole edges."""

    def in_view(
        matrix: Float[Array, "4 4"], behind: Bool[Array, "S"]
    ) -> tuple[Array, Array, Array, Array]:
        seen = with_outline(wireframe, centre_in_object(matrix))
        view = predict_view(seen, camera, matrix)
        visible = view.sample_visible & ~behind
        px = jnp.where(visible, view.sample_px, 0.0)
        samples = jnp.where(visible[:, None], view.samples, 0.0)
        d = view.directions
        n = jnp.stack([-d[:, 1], d[:, 0]], axis=1)
        J = pose_jacobians(seen.samples, camera, matrix)[1]
        J = jnp.einsum("si,sij->sj", n, jnp.where(visible[:, None, None], J, 0.0))
        # An edge of length l has the variance c s^2 / l + s_edge^2; each sample has its share of
        # weight.
        curve_px = jnp.zeros(seen.curve_count).at[seen.sample_curves].add(px)
        length = jnp.maximum(curve_px[seen.sample_curves], 1.0)
        variance = SMOOTHED_LENGTH * sigmas[0] ** 2 / length + sigmas[1] ** 2
        weights = px / length / variance
        return samples, d, px, jnp.einsum("s,si,sj->ij", weights, J, J)

    return jax.vmap(in_view)(camera_from_object, hidden)
