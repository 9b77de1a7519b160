"""Refine points and lines of an object together, under constraints."""

from .constraint_geometry import Edge as Edge
from .constraint_geometry import LineIndex as LineIndex
from .constraint_geometry import Shape as Shape
from .constraints import AbstractConstraint as AbstractConstraint
from .constraints import EqualLength as EqualLength
from .constraints import KnownLength as KnownLength
from .constraints import OnPlane as OnPlane
from .constraints import Parallel as Parallel
from .constraints import RightAngle as RightAngle
from .constraints import SamePlane as SamePlane
from .constraints import Symmetric as Symmetric
from .picture_equations import ModelObservations as ModelObservations
from .refined_features import ConstraintVerdict as ConstraintVerdict
from .refined_features import RefinedFeatures as RefinedFeatures
from .refinement import refine as refine
from .suspect_clicks import SuspectClick as SuspectClick
from .suspect_clicks import suspect_clicks as suspect_clicks
