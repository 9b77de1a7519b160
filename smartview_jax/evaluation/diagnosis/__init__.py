"""Diagnose where an error comes from: its budget, explanations, and agreement between halves."""

from .budget import ErrorBudget as ErrorBudget
from .budget import error_budget as error_budget
from .explanations import Explanation as Explanation
from .explanations import explanations as explanations
from .explanations import region_error as region_error
from .lens_misfit import lens_misfit as lens_misfit
from .repeatability import Repeatability as Repeatability
from .repeatability import repeatability as repeatability
