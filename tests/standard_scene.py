"""One number of views and of points, so that many tests share the programs of one shape."""

from smartview_jax.simulation import paper_points

VIEWS = 16
"""Not padded, and enough for every part of a calibration."""

POINTS = paper_points((0.0, 0.02))[::4]
"""On two heights; 21, which are padded to 32."""
