"""Provide data sets: the points of a target in pictures from several robot poses."""

from .dataset import MINIMUM_RELIABLE_VIEWS as MINIMUM_RELIABLE_VIEWS
from .dataset import Dataset as Dataset
from .input_checks import FORWARD_KINEMATICS_TOLERANCE as FORWARD_KINEMATICS_TOLERANCE
from .observations import Observations as Observations
from .observations import chain_residuals as chain_residuals
from .observations import medians_by_view as medians_by_view
from .observations import view_residuals as view_residuals
