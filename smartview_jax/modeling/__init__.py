"""Measure objects in several calibrated views: points, straight lines, and what binds them."""

from .point_estimation import PointStatus as PointStatus
from .triangulation import TriangulatedPoints as TriangulatedPoints
from .triangulation import triangulate_points as triangulate_points
