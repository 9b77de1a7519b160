"""Measure objects in several calibrated views: points, straight lines, and what binds them."""

from .epipolar import EpipolarCurve as EpipolarCurve
from .epipolar import epipolar_curve as epipolar_curve
from .epipolar import epipolar_curves as epipolar_curves
from .point_estimation import PointStatus as PointStatus
from .triangulation import TriangulatedPoints as TriangulatedPoints
from .triangulation import triangulate_points as triangulate_points
