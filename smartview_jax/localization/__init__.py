"""Find known objects in calibrated pictures: hypotheses, verification and the next view."""

from .distinct_poses import distinct_poses as distinct_poses
from .distinct_poses import pose_distances as pose_distances
from .hypotheses import Hypothesis as Hypothesis
from .hypotheses import find_hypotheses as find_hypotheses
from .polishing import polished_poses as polished_poses
from .prediction import PredictedView as PredictedView
from .prediction import hidden_samples as hidden_samples
from .prediction import hidden_vertices as hidden_vertices
from .prediction import pose_jacobians as pose_jacobians
from .prediction import predict_view as predict_view
from .prediction import search_regions as search_regions
from .scoring import PoseScores as PoseScores
from .scoring import SceneMaps as SceneMaps
from .scoring import score_poses as score_poses
from .wireframe import EDGE_SAMPLES as EDGE_SAMPLES
from .wireframe import Wireframe as Wireframe
