"""Measure objects in several calibrated views: points, straight lines, and what binds them."""

from .epipolar import EpipolarCurve as EpipolarCurve
from .epipolar import epipolar_curve as epipolar_curve
from .epipolar import epipolar_curves as epipolar_curves
from .line_jacobians import Lines as Lines
from .line_triangulation import TriangulatedLines as TriangulatedLines
from .line_triangulation import triangulate_lines as triangulate_lines
from .point_estimation import PointStatus as PointStatus
from .triangulation import TriangulatedPoints as TriangulatedPoints
from .triangulation import triangulate_points as triangulate_points
