"""Measure objects in several calibrated views: points, straight lines, and what binds them."""

from .constraint_verdicts import ConstraintVerdict as ConstraintVerdict
from .constraints import AbstractConstraint as AbstractConstraint
from .constraints import Edge as Edge
from .constraints import EqualLength as EqualLength
from .constraints import KnownLength as KnownLength
from .constraints import LineIndex as LineIndex
from .constraints import OnPlane as OnPlane
from .constraints import Parallel as Parallel
from .constraints import RightAngle as RightAngle
from .constraints import SamePlane as SamePlane
from .constraints import Symmetric as Symmetric
from .epipolar import EpipolarCurve as EpipolarCurve
from .epipolar import epipolar_curve as epipolar_curve
from .epipolar import epipolar_curves as epipolar_curves
from .line_jacobians import Lines as Lines
from .line_triangulation import TriangulatedLines as TriangulatedLines
from .line_triangulation import triangulate_lines as triangulate_lines
from .picture_equations import ModelObservations as ModelObservations
from .point_estimation import PointStatus as PointStatus
from .refined_features import RefinedFeatures as RefinedFeatures
from .refinement import refine as refine
from .triangulation import TriangulatedPoints as TriangulatedPoints
from .triangulation import triangulate_points as triangulate_points
