"""One number of views and of points, so that many tests share the programs of one shape."""

from smartview_jax.simulation import paper_points

VIEWS = 16
"""Not padded, and enough for every part of a calibration."""

POINTS = paper_points((0.0, 0.02))[::5][:16]
"""Eight on each of two heights: as many as the programs of `fit_scenes` have room for."""
