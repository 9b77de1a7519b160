"""Quantify the uncertainty of results: covariances, lower bounds, and tests of both."""

from .consistency import ConsistencyStatistic as ConsistencyStatistic
from .consistency import coverage as coverage
from .consistency import mean_nees as mean_nees
from .consistency import nees as nees
from .consistency import within_interval as within_interval
from .cramer_rao import CramerRaoBound as CramerRaoBound
from .cramer_rao import RigBound as RigBound
from .cramer_rao import cramer_rao as cramer_rao
from .maps import PictureUncertainty as PictureUncertainty
from .maps import WorkspaceUncertainty as WorkspaceUncertainty
from .maps import picture_uncertainty as picture_uncertainty
from .maps import workspace_uncertainty as workspace_uncertainty
from .propagation import CalibrationEstimate as CalibrationEstimate
from .propagation import covariance_of as covariance_of
from .propagation import covariance_root as covariance_root
from .propagation import std_of as std_of
from .propagation import sum_of_squared_derivatives as sum_of_squared_derivatives
