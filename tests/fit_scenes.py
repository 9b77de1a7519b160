"""The scenes on which the tests try fits: of few sizes, so that all share the fits' programs."""

import dataclasses
import functools

from smartview_jax.simulation import paper_points, random_scene

VIEWS = 8
"""Half as many as the programs for few views have room for."""

MANY_VIEWS = 16
"""Enough for a robot of unknown build to be tried, and for views to be left out.

The programs are those for few views.
"""

POINTS = paper_points((0.0, 0.02))[::6]
"""Seven on each of two planes."""


@functools.cache
def scene_of(seed, views=VIEWS, **noise):
    """The paper's set-up over the points; scenes are immutable, and each is made once."""
    return random_scene(seed, views, POINTS, **noise)


def scene_with(truth, seed, views=VIEWS, **noise):
    """The same for another calibration."""
    return random_scene(seed, views, POINTS, truth, **noise)


def thinned(data, step):
    """The data with one point out of so many of the board, which still spread over all of it."""
    kept = {name: getattr(data, name)[:, ::step] for name in ("points", "pixels", "visible")}
    return dataclasses.replace(data, **kept)
