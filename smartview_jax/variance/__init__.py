"""Estimate the standard deviations of all errors by restricted likelihood, over several models."""

from .alternatives import MINIMUM_RELIABLE_VIEWS as MINIMUM_RELIABLE_VIEWS
from .alternatives import SCALE as SCALE
from .doubt import p_value as p_value
from .estimate import DECIDED as DECIDED
from .estimate import FINEST as FINEST
from .estimate import Alternative as Alternative
from .estimate import NoiseEstimate as NoiseEstimate
from .estimate import estimate_noise as estimate_noise
