"""Measure how much of a known object background clutter explains, at other places of the pictures.

The wireframe is displaced and refined on the edges near by, as a hypothesis is. A beta distribution
fitted to the shares that it explains there says how rarely clutter explains more.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import betainc, binom, gammaln

from ..geometry import host_exponentials
from ..modeling import ObjectModel, SeenViews
from .edge_lines import EXPLAINED_DISTANCE, MIN_POINT_SIGMA
from .edge_lookup import EdgeLookup
from .pose_convergence import poses_on_edges
from .wireframe import Wireframe

CHANCE_POSES = 48
"""Number of displaced poses from which chance is estimated."""

DISPLACEMENTS, MAX_TURN = (0.5, 3.0), float(np.deg2rad(40.0))
"""Smallest and largest displacement, over the extent of the object, and largest turn, rad."""

RETURNED_DISTANCE = 0.3
"""Distance from the object, over its extent, within which a pose has returned to it."""

MIN_PLACES = 5
"""Smallest number of places from which chance is estimated."""

MIN_EXACT_EDGES = 4
"""Smallest number of edges for which the probability of a chance fit is computed."""

MIN_VISIBLE = 0.25
"""Smallest visible edge length of a displaced pose that counts, over the median of all poses.

Where the wireframe is almost outside the pictures, one edge point may explain all that is visible.
"""


class Chance(NamedTuple):
    """The explained share of a wireframe's edges where the object is not.

    Attributes:
        mean, std: mean and standard deviation of the shares.
    """

    mean: float
    std: float

    def probability_above(self, share: float) -> float:
        """Return the probability that chance explains at least a share.

        The tail, for which there are no samples, is taken from a beta distribution with the same
        mean and standard deviation.
        """
        # A beta distribution needs a variance below mean (1 - mean); with few places it may be
        # zero.
        mean = float(np.clip(self.mean, 0.02, 0.98))
        variance = float(np.clip(self.std**2, 1e-4, 0.8 * mean * (1.0 - mean)))
        count = mean * (1.0 - mean) / variance - 1.0
        # 1 - I_x(a, b) = I_(1-x)(b, a), which keeps its digits where it is small.
        return float(betainc((1.0 - mean) * count, mean * count, 1.0 - min(share, 1.0)))


NOTHING_ELSE = Chance(0.05, 0.05)
"""Chance where the pictures show nothing else: clutter explains next to nothing."""


class ChancePoses(NamedTuple):
    """The poses to which displaced wireframes converged on the edges of the pictures.

    Attributes:
        world_from_object: the poses.
        lengths: visible edge length of each pose and its explained part, px.
    """

    world_from_object: Float[np.ndarray, "poses 4 4"]
    lengths: Float[np.ndarray, "poses 2"]


def chance_poses(
    pose: Float[np.ndarray, "4 4"],
    model: ObjectModel,
    wireframe: Wireframe,
    views: SeenViews,
    lookup: EdgeLookup,
    seed: int = 0,
) -> ChancePoses:
    """Return poses away from the object, refined on the edges of the pictures.

    The wireframe is displaced by `DISPLACEMENTS`, turned by up to `MAX_TURN` and refined on the
    edges near by, as a hypothesis is.

    Args:
        pose: pose of the object, from which the wireframe is displaced.
        model: of the object.
        wireframe: of the model; few samples are enough.
        views: camera and poses.
        lookup: edge points of the views.
        seed: seed of the random displacements.
    """
    rng = np.random.default_rng(seed)
    extent = model.extent
    tangents = np.zeros((CHANCE_POSES, 6))
    directions = rng.standard_normal((CHANCE_POSES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tangents[:, :3] = rng.uniform(*DISPLACEMENTS, (CHANCE_POSES, 1)) * extent * directions
    axes = rng.standard_normal((CHANCE_POSES, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    tangents[:, 3:] = rng.uniform(0.0, MAX_TURN, (CHANCE_POSES, 1)) * axes
    # Turn about the middle of the object, not about the origin of its frame.
    middle = _middle_frame(model)
    displaced = pose @ middle @ host_exponentials(tangents) @ np.linalg.inv(middle)
    return ChancePoses(*poses_on_edges(wireframe, views, lookup, displaced))


def chance_of(pose: Float[np.ndarray, "4 4"], model: ObjectModel, tried: ChancePoses) -> Chance:
    """Return the share of a wireframe's visible length that other places of the pictures explain.

    Poses that returned to the object are left out, and so are poses at which hardly anything is
    visible.

    Args:
        pose: pose of the object that is judged.
        model: of the object.
        tried: poses to which its wireframe converged, displaced from this pose or from another one.
    """
    middle = _middle_frame(model)
    moved = tried.world_from_object @ middle - pose @ middle
    extent = model.extent
    elsewhere = np.linalg.norm(moved[:, :3, 3], axis=1) > RETURNED_DISTANCE * extent
    visible, explained = tried.lengths.T
    shares = explained / np.maximum(visible, 1.0)
    is_visible = visible >= MIN_VISIBLE * np.median(visible)
    values = shares[elsewhere & is_visible & (shares > 0.0)]
    if len(values) < MIN_PLACES:
        return NOTHING_ELSE
    return Chance(float(values.mean()), float(values.std(ddof=1)))


def _middle_frame(model: ObjectModel) -> Float[np.ndarray, "4 4"]:
    """Return object_from_middle, with the middle of the vertices as the origin."""
    middle = np.eye(4)
    middle[:3, 3] = model.vertices.mean(axis=0)
    return middle


def log_odds_of(log_likelihood: float, log_exactness: float) -> float:
    """Return the log-likelihood ratio to clutter, including how exactly the edges fit.

    Args:
        log_likelihood: natural logarithm of the likelihood ratio of found and missing edges.
        log_exactness: decimal logarithm from `log_chance_of_exact_edges`.
    """
    return log_likelihood - float(np.log(10.0)) * log_exactness


def log_chance_of_exactness(rms: float, edges: int, absorbed: float = 0.0) -> float:
    """Return the decimal logarithm of the probability that clutter edges fit this exactly.

    By chance each edge's two numbers are uniform within `EXPLAINED_DISTANCE`; the six numbers of
    the pose and those that errors of the calibration absorb are subtracted (Moisan and Stival, "A
    probabilistic criterion to detect rigid point matches", 2004).
    """
    # The ball sum x^2 <= n r^2 has the part pi^(n/2) (r sqrt(n))^n / Gamma(n/2 + 1) of the cube
    # (2 d)^n.
    n = 2 * edges - 6 - absorbed
    if n <= 0:
        return 0.0
    radius = max(rms, MIN_POINT_SIGMA) / np.sqrt(2.0) * np.sqrt(n)
    part = 0.5 * n * np.log(np.pi) + n * np.log(radius / (2.0 * EXPLAINED_DISTANCE))
    return min(float((part - gammaln(0.5 * n + 1.0)) / np.log(10.0)), 0.0)


def log_chance_of_exact_edges(
    distances: Float[np.ndarray, "edges"], absorbed: float = 0.0
) -> float:
    """Return the decimal logarithm of the expected number of edge sets that fit so well by chance.

    An edge of another object next to an edge of this one is no evidence against the other edges.
    For each k the k best edges are tested, and the least probable of these sets counts. All sets
    of k out of n edges might have been chosen, which the number of sets corrects for (Moisan and
    Stival).

    Args:
        distances: distances of the measured edges from the model, px.
        absorbed: as in `log_chance_of_exactness`.
    """
    n, squares = len(distances), np.cumsum(np.sort(distances) ** 2)
    sizes = range(MIN_EXACT_EDGES, n + 1)
    logs = [
        np.log10(len(sizes) * binom(n, k))
        + log_chance_of_exactness(float(np.sqrt(squares[k - 1] / k)), k, absorbed)
        for k in sizes
    ]
    return float(min(0.0, *logs)) if logs else 0.0
