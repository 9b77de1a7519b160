"""Quantify how well a result is known: covariances, lower bounds, and tests of both."""

from .consistency import Measured as Measured
from .consistency import coverage as coverage
from .consistency import covered as covered
from .consistency import mean_nees as mean_nees
from .consistency import nees as nees
from .cramer_rao import Bound as Bound
from .cramer_rao import cramer_rao as cramer_rao
from .propagation import Estimate as Estimate
from .propagation import covariance_of as covariance_of
from .propagation import std_of as std_of
from .propagation import sum_of_squares as sum_of_squares
