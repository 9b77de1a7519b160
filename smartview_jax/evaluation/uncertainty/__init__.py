"""Quantify how well a result is known: covariances, lower bounds, and tests of both."""

from .consistency import ConsistencyStatistic as ConsistencyStatistic
from .consistency import coverage as coverage
from .consistency import mean_nees as mean_nees
from .consistency import nees as nees
from .consistency import within_interval as within_interval
from .cramer_rao import CramerRaoBound as CramerRaoBound
from .cramer_rao import cramer_rao as cramer_rao
from .propagation import CalibrationEstimate as CalibrationEstimate
from .propagation import covariance_of as covariance_of
from .propagation import covariance_root as covariance_root
from .propagation import std_of as std_of
from .propagation import sum_of_squared_derivatives as sum_of_squared_derivatives
