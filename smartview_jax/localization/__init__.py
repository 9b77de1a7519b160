"""Find known objects in calibrated pictures: hypotheses, verification and the next view."""

from .prediction import PredictedView as PredictedView
from .prediction import hidden_samples as hidden_samples
from .prediction import hidden_vertices as hidden_vertices
from .prediction import pose_jacobians as pose_jacobians
from .prediction import predict_view as predict_view
from .prediction import search_regions as search_regions
from .wireframe import EDGE_SAMPLES as EDGE_SAMPLES
from .wireframe import Wireframe as Wireframe
