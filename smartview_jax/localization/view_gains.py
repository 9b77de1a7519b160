"""Compute how much each of many views would tell about objects that were found.

A gain is in natural units of information: the expected difference of log-likelihoods between each
hypothesis and its rivals, that there is nothing at all being one, and half the logarithm by which
the covariance of the grasp shrinks. What known surfaces and other objects hide of an object in a
view tells nothing of it there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..cameras import Camera
from ..engine import Noise
from ..geometry import host_adjoints, host_cross_matrices
from ..modeling import ObjectModel
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled_optimised
from ..runtime.padding import repeat_last
from .edge_lines import CORRELATED_LENGTH, MIN_POINT_SIGMA
from .evidence import FOUND_PROBABILITY, INDEPENDENT_LENGTH, TYPICAL_CHANCE
from .localization import Localization
from .occluders import Occluder, hidden_in_views, leading, occluders_beside
from .prediction import pose_jacobians, predict_view
from .verdict import MIN_MARGIN
from .wireframe import Wireframe

SAME_EDGE_DISTANCE, SAME_EDGE_COSINE = 4.0, 0.9
"""Distance, px, and cosine of directions within which edges of two hypotheses look alike."""

ENOUGH_MARGIN = 4.0 * MIN_MARGIN
"""Difference of log-likelihoods beyond which a rival needs no further telling apart."""

MAX_RIVALS = 6
"""Largest number of rivals of each object that are told apart."""

POSES_PER_BATCH = 64
"""Number of poses that are predicted at once, by one compiled program for any number."""


class _Predicted(NamedTuple):
    """The visible edges of one hypothesis in all candidate views, and their information.

    Attributes:
        samples: px.
        directions: unit directions of the edges.
        visible_px: length that each sample stands for; zero where it is not visible.
        information: of the pose's tangent at the object.
    """

    samples: Float[np.ndarray, "views S 2"]
    directions: Float[np.ndarray, "views S 2"]
    visible_px: Float[np.ndarray, "views S"]
    information: Float[np.ndarray, "views 6 6"]


class _Candidates(NamedTuple):
    """Candidate views of one object.

    Attributes:
        calibration: with the camera.
        camera_from_world: of the views.
        occluders: what may hide the object.
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
        self.is_open = any(one.verdict.decision == "open" for one in objects)
        there = leading([*neighbours, *objects])
        for one in objects:
            views = _Candidates(calibration, candidates, occluders_beside(one, there, triangles))
            own = _predicted(one.model, one.world_from_object, views, one)
            self.visible |= own.visible_px.sum(axis=1) > 0.0
            before, after = _grasp_covariances(one, own, candidates, noise)
            shrinkage += 0.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1])
            self.std_before = max(self.std_before, _position_std(before[None])[0])
            self.std_after = np.maximum(self.std_after, _position_std(after))
            needed = max(ENOUGH_MARGIN - one.verdict.evidence.log_likelihood, 0.0)
            gains = [np.minimum(_against_nothing(own), needed)]
            for rival in one.rivals[:MAX_RIVALS]:
                if rival.model != one.model_index and rival.model >= len(models):
                    continue
                margin = one.verdict.evidence.log_odds - rival.log_odds
                model = one.model if rival.model == one.model_index else models[rival.model]
                other = _predicted(model, rival.world_from_object, views, one)
                needed = max(ENOUGH_MARGIN - margin, 0.0)
                self.rivals += needed > 0.0
                gains.append(np.minimum(_difference(own, other), needed))
            self.discrimination += np.sum(gains, axis=0)
        self.total = np.where(self.visible, self.discrimination + shrinkage, -np.inf)

    def reason(self, best: int, paper: int | None) -> str:
        """Return what a view is expected to tell, as a clause; beside the paper's view, if any."""
        after = 1e3 * self.std_after[best]
        narrowed = (
            f"the position is known to {after:.3g} mm after it, {1e3 * self.std_before:.3g} mm now"
        )
        return f"{self._told(best)}; {narrowed}; {self._beside_paper(best, paper)}"

    def _told(self, best: int) -> str:
        """Return in words what a view tells of whether the objects are there."""
        # A difference of log-likelihoods is easier read as odds: 2.3 makes ten to one.
        odds = 10.0 ** round(float(self.discrimination[best]) / np.log(10.0), 1)
        expected = f"at expected odds of {odds:.2g} : 1"
        is_one = self.count == 1
        object_is = "the object is" if is_one else "the objects are"
        if self.rivals:
            rivals = "rival" if self.rivals == 1 else "rivals"
            return f"it tells {self.rivals} remaining {rivals} apart, {expected}"
        if odds > 1.0 and self.is_open:
            return f"it tells whether {object_is} there, {expected}"
        if odds > 1.0:
            return f"it makes the object{'' if is_one else 's'} more certain, {expected}"
        # Open for want of edges or views, where no odds are left to gain.
        if self.is_open:
            return f"{object_is} still open, and shown once more"
        return f"{object_is} certain already"

    def _beside_paper(self, best: int, paper: int | None) -> str:
        """Return in words what the paper's view would tell instead."""
        if paper is None:
            return "the view along the normal of the top surface is not reached"
        # Beside itself it would tell "100% as much".
        if paper == best:
            return "it is the paper's view, along the normal of the top surface"
        # Gains are information; their ratio says enough.
        part = max(float(self.total[paper] / max(self.total[best], 1e-12)), 0.0)
        return (
            f"the paper's view, along the normal of the top surface, would tell {part:.0%} as much"
        )


def _position_std(covariances: Float[np.ndarray, "views 6 6"]) -> Float[np.ndarray, "views"]:
    """Return the standard deviation of position in its worst direction."""
    return np.sqrt(np.linalg.eigvalsh(covariances[:, :3, :3])[:, -1])


def _grasp_covariances(
    one: Localization,
    own: _Predicted,
    candidates: Float[np.ndarray, "views 4 4"],
    noise: Noise | None,
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "views 6 6"]]:
    """Return the covariance of where fingers meet the object, now and after each view.

    Errors of calibration and model stay as they are; those of the pictures shrink.
    """
    refined = one.refined
    fixed = refined.calibration + refined.model
    information = own.information
    if noise is not None and np.isfinite([noise.translation, noise.rotation]).all():
        information = _with_view_noise(information, one.world_from_object, candidates, noise)
    weight = np.linalg.inv(refined.pictures)
    after = np.linalg.inv(weight + information) + fixed
    # The point between the fingers: of the first grasp, or the middle of the object.
    grasps, vertices = one.model.grasps, one.model.vertices
    point = grasps[0].object_from_tool[:3, 3] if grasps else vertices.mean(axis=0)
    shift = np.eye(6)
    # A tangent (v, w) moves the point by v + w x p.
    shift[:3, 3:] = -host_cross_matrices(point)
    return shift @ refined.covariance @ shift.T, shift @ after @ shift.T


def _with_view_noise(
    information: Float[np.ndarray, "views 6 6"],
    pose: Float[np.ndarray, "4 4"],
    candidates: Float[np.ndarray, "views 4 4"],
    noise: Noise,
) -> Float[np.ndarray, "views 6 6"]:
    """Return the information of views whose camera pose has the robot's noise.

    The lever from the tool to the camera is left out: it is short against the distance.
    """
    # A twist of the camera is one of the object: Q = Ad S Ad^T, and (I^-1 + Q)^-1 = I (1 + Q I)^-1.
    sigmas = np.repeat([noise.translation, noise.rotation], 3)
    adjoint = host_adjoints(np.linalg.inv(candidates @ pose))
    Q = adjoint @ np.diag(sigmas**2) @ adjoint.swapaxes(1, 2)
    return information @ np.linalg.inv(np.eye(6) + Q @ information)


def _against_nothing(own: _Predicted) -> Float[np.ndarray, "views"]:
    """Return the expected log-likelihood of visible edges over that nothing is there."""
    return (
        own.visible_px.sum(axis=1)
        / INDEPENDENT_LENGTH
        * _information_of_piece(FOUND_PROBABILITY, TYPICAL_CHANCE)
    )


def _information_of_piece(p: float, q: float) -> float:
    """Return the expected log-likelihood of probability p over q, if p is true."""
    return float(p * np.log(p / q) + (1.0 - p) * np.log((1.0 - p) / (1.0 - q)))


def _difference(own: _Predicted, other: _Predicted) -> Float[np.ndarray, "views"]:
    """Return the expected log-likelihood of a hypothesis over another, if the first is true.

    Edges that both predict alike tell nothing. An edge that only the first predicts is found; one
    that only the other predicts is found by chance.
    """
    mine, theirs = (
        np.where(_alike(a, b), 0.0, a.visible_px).sum(axis=1) / INDEPENDENT_LENGTH
        for a, b in ((own, other), (other, own))
    )
    p, q = FOUND_PROBABILITY, TYPICAL_CHANCE
    return mine * _information_of_piece(p, q) + theirs * _information_of_piece(q, p)


def _alike(first: _Predicted, second: _Predicted) -> Bool[np.ndarray, "views S"]:
    """Return which samples of the first lie on edges of the second, of the same direction."""
    found = np.zeros(first.visible_px.shape, dtype=bool)
    for view in range(len(found)):
        seen = second.visible_px[view] > 0.0
        gap = first.samples[view][:, None] - second.samples[view][seen][None]
        d = second.directions[view][seen]
        across = np.abs(gap[..., 0] * d[:, 1] - gap[..., 1] * d[:, 0])
        along = np.abs((gap * d).sum(axis=2))
        parallel = np.abs(first.directions[view] @ d.T) > SAME_EDGE_COSINE
        near = (across < SAME_EDGE_DISTANCE) & (along < second.visible_px[view][seen] + 1.0)
        found[view] = (near & parallel).any(axis=1)
    return found


def _predicted(
    model: ObjectModel,
    pose: Float[np.ndarray, "4 4"],
    views: _Candidates,
    one: Localization,
) -> _Predicted:
    """Return the visible edges of a hypothesis in all candidate views."""
    candidates = views.camera_from_world
    wireframe, parts = Wireframe.of(model), []
    sigma = max(float(one.refined.edge_sigma), MIN_POINT_SIGMA)
    scatter = one.refined.lines.scatter[one.refined.consistent]
    point_sigma = max(float(np.median(scatter)) if len(scatter) else 0.0, MIN_POINT_SIGMA)
    in_world = np.asarray(wireframe.samples) @ pose[:3, :3].T + pose[:3, 3]
    for start in range(0, len(candidates), POSES_PER_BATCH):
        own = candidates[start : start + POSES_PER_BATCH]
        padded = repeat_last(own, POSES_PER_BATCH)
        centres = np.linalg.inv(padded)[:, :3, 3]
        found = _predict_edges(
            wireframe,
            views.calibration.camera,
            to_device(padded @ pose),
            to_device(hidden_in_views(views.occluders, centres, in_world)),
            to_device(np.array([point_sigma, sigma])),
        )
        parts.append([np.asarray(array)[: len(own)] for array in found])
    return _Predicted(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


@compiled_optimised
def _predict_edges(
    wireframe: Wireframe,
    camera: Camera,
    camera_from_object: Float[Array, "views 4 4"],
    hidden: Bool[Array, "views S"],
    sigmas: Float[Array, "2"],
) -> tuple[Array, Array, Array, Array]:
    """Return the parts of `_Predicted`, for the noise of edge points and that of whole edges."""

    def in_view(
        matrix: Float[Array, "4 4"], behind: Bool[Array, "S"]
    ) -> tuple[Array, Array, Array, Array]:
        view = predict_view(wireframe, camera, matrix)
        visible = view.sample_visible & ~behind
        px = jnp.where(visible, view.sample_px, 0.0)
        samples = jnp.where(visible[:, None], view.samples, 0.0)
        d = view.directions
        n = jnp.stack([-d[:, 1], d[:, 0]], axis=1)
        J = pose_jacobians(wireframe.samples, camera, matrix)[1]
        J = jnp.einsum("si,sij->sj", n, jnp.where(visible[:, None, None], J, 0.0))
        # An edge of length l has the variance c s^2 / l + s_edge^2; a sample, its share of that.
        edge_px = jnp.zeros(len(wireframe.edges)).at[wireframe.sample_edges].add(px)
        length = jnp.maximum(edge_px[wireframe.sample_edges], 1.0)
        variance = CORRELATED_LENGTH * sigmas[0] ** 2 / length + sigmas[1] ** 2
        weights = px / length / variance
        return samples, d, px, jnp.einsum("s,si,sj->ij", weights, J, J)

    return jax.vmap(in_view)(camera_from_object, hidden)
