"""Measure how much of a known object chance explains: at other places of the same pictures.

The wireframe is displaced and drawn to the best place near by, as a hypothesis is. A beta
distribution of the shares that it explains there says how rarely chance explains more.
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
"""Smallest number of places that tell of chance."""

MIN_EXACT_EDGES = 4
"""Smallest number of edges of which it is asked whether chance fits them so well."""

MIN_VISIBLE = 0.25
"""Smallest visible edge length of a pose that tells of chance, over the median of all poses.

Of a wireframe that is all but outside the pictures one edge point may explain the whole.
"""


class Chance(NamedTuple):
    """The explained share of a wireframe at places where the object is not.

    Attributes:
        mean, std: of the shares.
    """

    mean: float
    std: float

    def probability_above(self, share: float) -> float:
        """Return the probability that chance explains at least a share.

        A beta distribution of the same mean and standard deviation stands for the tail, in which
        there are no samples.
        """
        # A beta distribution's variance is below mean (1 - mean); that of few places may be zero.
        mean = float(np.clip(self.mean, 0.02, 0.98))
        variance = float(np.clip(self.std**2, 1e-4, 0.8 * mean * (1.0 - mean)))
        count = mean * (1.0 - mean) / variance - 1.0
        # 1 - I_x(a, b) = I_(1-x)(b, a), which keeps its digits where it is small.
        return float(betainc((1.0 - mean) * count, mean * count, 1.0 - min(share, 1.0)))


NOTHING_ELSE = Chance(0.05, 0.05)
"""Chance where nothing else is in the pictures: it explains next to nothing."""


class ChancePoses(NamedTuple):
    """The poses to which a displaced wireframe is drawn by what the pictures show.

    Attributes:
        world_from_object: the poses.
        lengths: visible edge length of each, and the part of it that is explained, px.
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
    """Return poses at which a model is looked for in vain, drawn to the edges of the pictures.

    The wireframe is displaced by `DISPLACEMENTS`, turned by up to `MAX_TURN` and drawn to the best
    place near by, as a hypothesis is.

    Args:
        pose: of the object about which it is displaced.
        model: of the object.
        wireframe: of the model; few samples are enough.
        views: camera and poses.
        lookup: edge points of the views.
        seed: of the displacements.
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
    # Displaced about the object's middle, not about the origin of its frame.
    middle = _middle_frame(model)
    displaced = pose @ middle @ host_exponentials(tangents) @ np.linalg.inv(middle)
    return ChancePoses(*poses_on_edges(wireframe, views, lookup, displaced))


def chance_of(pose: Float[np.ndarray, "4 4"], model: ObjectModel, tried: ChancePoses) -> Chance:
    """Return how much of a wireframe's visible length other places of the pictures explain.

    Poses that returned to the object itself are left out, and so are those of which the pictures
    show next to nothing.

    Args:
        pose: of the object that is judged.
        model: of the object.
        tried: where its wireframe was drawn to, displaced from this pose or from another one.
    """
    middle = _middle_frame(model)
    moved = tried.world_from_object @ middle - pose @ middle
    extent = model.extent
    elsewhere = np.linalg.norm(moved[:, :3, 3], axis=1) > RETURNED_DISTANCE * extent
    visible, explained = tried.lengths.T
    shares = explained / np.maximum(visible, 1.0)
    seen = visible >= MIN_VISIBLE * np.median(visible)
    values = shares[elsewhere & seen & (shares > 0.0)]
    if len(values) < MIN_PLACES:
        return NOTHING_ELSE
    return Chance(float(values.mean()), float(values.std(ddof=1)))


def _middle_frame(model: ObjectModel) -> Float[np.ndarray, "4 4"]:
    """Return object_from_middle, with the middle of the vertices as the origin."""
    middle = np.eye(4)
    middle[:3, 3] = model.vertices.mean(axis=0)
    return middle


def log_odds_of(log_likelihood: float, log_exactness: float) -> float:
    """Return the log-likelihood over that of clutter, with how exactly the edges fit.

    Args:
        log_likelihood: of edges being found or not, natural.
        log_exactness: of `log_chance_of_exact_edges`, decimal.
    """
    return log_likelihood - float(np.log(10.0)) * log_exactness


def log_chance_of_exactness(rms: float, edges: int, absorbed: float = 0.0) -> float:
    """Return the decimal logarithm of the probability that edges of clutter fit so well.

    Two numbers of each edge, less the six of the pose and those that errors of the calibration
    absorb, are anywhere within `EXPLAINED_DISTANCE` by chance (Moisan and Stival, "A probabilistic
    criterion to detect rigid point matches", 2004).
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
    """Return the decimal logarithm of how many sets of edges fit so well by chance.

    An edge of something else beside one of the object's is no evidence against the others. Of the
    sets of k best edges the one counts that chance explains least, and the number of sets that it
    was chosen from counts against it: all of k out of n, for each k, as in Moisan and Stival.

    Args:
        distances: of the measured edges from the model, px.
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
