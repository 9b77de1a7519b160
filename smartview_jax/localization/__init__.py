"""Find known objects in calibrated pictures: hypotheses, verification and the next view."""

from .edge_lines import EdgeLines as EdgeLines
from .edge_lines import converged_poses as converged_poses
from .edge_lookup import EdgeLookup as EdgeLookup
from .match_equations import Matches as Matches
from .match_equations import match_equations as match_equations
from .matching import MatchedPose as MatchedPose
from .matching import PoseState as PoseState
from .matching import kalman_update as kalman_update
from .matching import match_features as match_features
from .prediction import PredictedView as PredictedView
from .prediction import hidden_samples as hidden_samples
from .prediction import hidden_vertices as hidden_vertices
from .prediction import pose_jacobians as pose_jacobians
from .prediction import predict_view as predict_view
from .prediction import search_regions as search_regions
from .refinement import FIT_SAMPLES as FIT_SAMPLES
from .refinement import RefinedPose as RefinedPose
from .refinement import pose_from_matches as pose_from_matches
from .refinement import refine_pose as refine_pose
from .wireframe import EDGE_SAMPLES as EDGE_SAMPLES
from .wireframe import Wireframe as Wireframe
