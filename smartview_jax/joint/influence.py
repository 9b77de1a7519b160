"""What single views do to a joint fit: how far each moves it, and whether its pose is believable.

Both in closed form, from the normal equations at the optimum. There all gradients cancel, so
without view i a Gauss-Newton step leads along `(R - R_i)^-1 g_i`, with `R_i` and `g_i` the view's
own part of the reduced matrix and gradient. And a correction `c_i` that a prior `N(0, S)` pulled to
zero scatters, if the model is true, with covariance `S - V_i`, `V_i` being its own covariance: this
distance is that of the view's free pose from where all others put it.

Reference: Cook, Detection of influential observation in linear regression, 1977.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc
from jaxtyping import Array, Float

from ..compilation import compiled
from ..engine import BlockArrow, JointProblem, Step, eliminate, select

TELLING = 1e-6
"""Share of a correction's prior variance that its view must explain, to say anything about it."""


class Influence(NamedTuple):
    """How far the shared parameters of a fit move if a view is left out.

    Attributes:
        moves: the fit without the view minus the fit with it, own units.
        std: standard deviations of the parameters in the fit with all views.
        parameter_names: of the columns.
        view_ids: of the rows.
        mount: path of the transform that says where the camera is mounted.
    """

    moves: Float[np.ndarray, "views free"]
    std: Float[np.ndarray, "free"]
    parameter_names: tuple[str, ...]
    view_ids: tuple[str, ...]
    mount: str

    def on(self, path: str | None = None) -> Float[np.ndarray, "views"]:
        """The largest move of a path's parameters, in their standard deviations.

        Args:
            path: by default the camera's mount: `camera_from_tool` of a camera in the hand,
                `camera_from_base` of one that stands.

        Raises:
            ValueError: the path names no free parameter.
        """
        chosen = select(self.parameter_names, (path or self.mount,))
        return np.abs(self.moves[:, chosen] / self.std[chosen]).max(axis=1)


@compiled
def moves_without(problem: JointProblem, z: Step) -> Float[Array, "views free"]:
    """How far the free shared parameters move if a view is left out, to first order.

    Args:
        problem: in the parameters' own units.
        z: its optimum.
    """
    matrix = problem.normal_equations(z).matrix
    parts, (gradient, own_part) = eliminate(matrix), problem.observed_by_view(z)
    if len(matrix.own):
        # At the optimum a view's own gradient is what its prior pulls with, and nothing is left.
        own_part = own_part - jnp.einsum("vki,vkj->vij", matrix.border, parts.gain)
    lengths = jnp.sqrt(jnp.diagonal(parts.reduced))
    unit = 1.0 / jnp.where(lengths > 0.0, lengths, 1.0)
    rest = (parts.reduced[None] - own_part) * unit[None, :, None] * unit[None, None]
    scaled = jnp.linalg.solve(rest, (gradient * unit[None])[..., None])[..., 0]
    return scaled * unit[None]


class PoseScores(NamedTuple):
    """How far each view's free pose lies from where the others put it.

    Attributes:
        distance: in standard deviations (Mahalanobis); if the sizes of errors were found from these
            same views, in those of the sizes without the view, which made them larger.
        p_value: of a distance at least as large by the sizes as they are.
    """

    distance: Float[Array, "views"]
    p_value: Float[Array, "views"]


@compiled
def pose_scores(
    problem: JointProblem, z: Step, matrix: BlockArrow, sizes_known: bool
) -> PoseScores:
    """Score every view's reported pose; views without corrections of all six score nothing.

    Args:
        problem: with priors on the corrections, in the parameters' own units.
        z: its optimum.
        matrix: of the normal equations there.
        sizes_known: whether the priors' sizes are given, and not found from these same views.
    """
    parts = eliminate(matrix)
    eye = jnp.eye(len(parts.reduced))
    lengths = jnp.sqrt(jnp.diagonal(parts.reduced))
    unit = jnp.diag(1.0 / jnp.where(lengths > 0.0, lengths, 1.0))
    shared = unit @ jnp.linalg.solve(unit @ parts.reduced @ unit, eye) @ unit
    covariance = parts.own_covariance(shared)

    weight = problem.prior_weight.corrections
    pull = weight * problem.off_mean(problem.step(z)).corrections
    explained = jnp.eye(6)[None] - weight[..., None] * covariance * weight[:, None]
    share, axes = jnp.linalg.eigh(explained)
    along = jnp.einsum("vki,vk->vi", axes, pull)
    scored = jnp.all(problem.own_free & (weight > 0.0), axis=1)
    telling = (share > TELLING) & scored[:, None]
    square = jnp.sum(jnp.where(telling, along**2 / jnp.where(telling, share, 1.0), 0.0), axis=1)
    degrees = jnp.sum(telling.astype(float), axis=1)
    counted = jnp.maximum(degrees, 1.0)
    p_value = jnp.where(degrees > 0.0, gammaincc(0.5 * counted, 0.5 * square), 1.0)
    if not sizes_known:
        # Of all squares together, as in regression: the rest tells the size without the view.
        whole = jnp.sum(jnp.where(telling, share, 0.0))
        rest = jnp.maximum(whole - square, 1e-3 * whole)
        square = square * jnp.maximum(whole - counted, 1.0) / jnp.where(rest > 0.0, rest, 1.0)
    return PoseScores(jnp.sqrt(square), p_value)
