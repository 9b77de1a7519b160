"""Products of many small matrices, as the engine forms them and written in other ways."""

import json
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

REPEATS = 20
ROWS, SHARED = 14, 17
"""Jacobian columns of a point (with its residual), and parameters that all views share."""


def main(views: int, points: int) -> None:
    """Print the seconds of each product and form as one line of JSON."""
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(0)
    columns = jnp.asarray(rng.normal(size=(views, ROWS, points)))
    border = jnp.asarray(rng.normal(size=(views, 6, SHARED)))
    twist = jnp.asarray(rng.normal(size=(views, 6, 6)))
    print(
        json.dumps(
            {
                "Gram, einsum": _seconds(lambda x: jnp.einsum("vrn,vsn->vrs", x, x), columns),
                "Gram, sums": _seconds(
                    lambda x: jnp.stack([(x[:, r, None] * x).sum(-1) for r in range(ROWS)], 1),
                    columns,
                ),
                "border, einsum": _seconds(lambda b: jnp.einsum("vki,vkj->ij", b, b), border),
                "border, sums": _seconds(
                    lambda b: (b[..., :, None] * b[..., None, :]).sum((0, 1)), border
                ),
                "6 x 6, einsum": _seconds(
                    lambda t, b: jnp.einsum("vkl,vli->vki", t, b), twist, border
                ),
                "6 x 6, sums": _seconds(
                    lambda t, b: (t[..., None] * b[:, None]).sum(2), twist, border
                ),
            }
        )
    )


def _seconds(function: Callable, *arguments: jax.Array) -> float:
    """Return the median seconds of a call of the compiled function."""
    program = jax.jit(function)
    jax.block_until_ready(program(*arguments))
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
