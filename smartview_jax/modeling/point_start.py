"""Start the estimation of points at the places nearest to all their rays, which is linear."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .point_equations import PointProblem, solve
from .point_status import MAX_RELATIVE_STD

_TINY = 1e-300
"""A divisor in place of zero, where the quotient is not used."""


def nearest_to_rays(
    problem: PointProblem,
) -> tuple[Float[Array, "points 3"], Bool[Array, "points"], Bool[Array, "points"]]:
    """Return the points nearest to their rays, whether the rays are parallel, and whether enough.

    A ray from centre c along the unit vector d is at the distance `|(I - d d^T)(x - c)|` from x,
    which is linear in x. The second pass divides each distance by the distance from the camera, so
    that angles count instead of metres.
    """
    camera, pose, whitening = problem.camera, problem.camera_from_world, problem.whitening
    rays, valid = camera.unproject(problem.pixels)
    used = problem.visible & valid
    # Rays of unused pixels are zero, and so are their weights.
    rays = jnp.where(used[..., None], rays, 0.0)
    d = [sum(pose[:, j, i, None] * rays[..., j] for j in range(3)) for i in range(3)]
    centres = [-sum(pose[:, j, i] * pose[:, j, 3] for j in range(3)) for i in range(3)]
    middle = [jnp.mean(c) for c in centres]
    c = [(centre - m)[:, None] for centre, m in zip(centres, middle, strict=True)]
    # An angle of one pixel is about 1 / sqrt(alpha_u alpha_v) rad.
    information = jnp.abs(
        whitening[..., 0, 0] * whitening[..., 1, 1] - whitening[..., 0, 1] * whitening[..., 1, 0]
    ) * (camera.alpha_u * camera.alpha_v)
    # The first pass weights all rays alike; only the second knows the distances.
    weight = jnp.where(used, information, 0.0)
    x = [jnp.zeros(problem.pixels.shape[1])] * 3
    relative_variance = x[0]
    # Normal equations of the squared distances: (sum w P) x = sum w P c with P = I - d d^T.
    for k in range(2):
        along = [sum(d[j] * c[j] for j in range(3)), d]
        normal = tuple(
            jnp.sum(weight * ((1.0 if i == j else 0.0) - d[i] * d[j]), axis=0)
            for i in range(3)
            for j in range(i, 3)
        )
        right = tuple(jnp.sum(weight * (c[i] - along[0] * d[i]), axis=0) for i in range(3))
        trace, solution = solve(normal, right)
        x = list(solution)
        if k == 0:
            relative_variance = trace
            squared_distance = sum((x[j][None] - c[j]) ** 2 for j in range(3))
            weight = weight / jnp.maximum(squared_distance, _TINY)
    # Relative to the middle of the cameras, the squares above keep more digits.
    start = jnp.stack([x[j] + middle[j] for j in range(3)], axis=-1)
    # A single ray has no nearest point; 1.5 separates one ray from two.
    enough = jnp.sum(used.astype(float), axis=0) > 1.5
    return start, ~(relative_variance < MAX_RELATIVE_STD**2), enough
