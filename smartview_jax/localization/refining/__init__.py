"""Refine a pose on the edges of the pictures: many poses roughly, or one with its covariance."""

from .heavy_tails import NUMBERS as NUMBERS
from .pose_convergence import POSES_PER_BATCH as POSES_PER_BATCH
from .pose_convergence import THREADS as THREADS
from .pose_convergence import lengths_at as lengths_at
from .pose_convergence import lengths_of_poses as lengths_of_poses
from .pose_convergence import poses_on_edges as poses_on_edges
from .pose_equations import CommonErrors as CommonErrors
from .pose_equations import PoseEquations as PoseEquations
from .pose_equations import PoseStep as PoseStep
from .pose_equations import UndeterminedPoseError as UndeterminedPoseError
from .pose_equations import line_equations as line_equations
from .pose_equations import places_on_edges as places_on_edges
from .pose_equations import samples_in_views as samples_in_views
from .pose_equations import solve_pose as solve_pose
from .refinement import FIT_SAMPLES as FIT_SAMPLES
from .refinement import RefinedPose as RefinedPose
from .refinement import explained_edge_points as explained_edge_points
from .refinement import measured_lines as measured_lines
from .refinement import refine_pose as refine_pose
