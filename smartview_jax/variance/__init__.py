"""Estimate the standard deviations of all errors by restricted likelihood, over several models."""

from ..deprecation import deprecated_names as _deprecated_names
from .kenward_roger import p_value as p_value
from .model_selection import TARGET_SCALE as TARGET_SCALE
from .variance_components import FREE_SCALE_PROBABILITY as FREE_SCALE_PROBABILITY
from .variance_components import SIGMA_FLOOR as SIGMA_FLOOR
from .variance_components import CandidateResult as CandidateResult
from .variance_components import NoiseEstimate as NoiseEstimate
from .variance_components import estimate_noise as estimate_noise

__getattr__ = _deprecated_names(__name__)
