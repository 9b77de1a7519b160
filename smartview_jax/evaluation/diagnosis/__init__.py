"""Diagnose where an error comes from: error budget, scale hypotheses, lens misfit, split halves."""

from .budget import error_budget as error_budget
from .causes import ErrorBudget as ErrorBudget
from .causes import lens_misfit as lens_misfit
from .rig_budget import PoseUncertainty as PoseUncertainty
from .rig_budget import RigErrorBudget as RigErrorBudget
from .rig_budget import pose_uncertainties as pose_uncertainties
from .scale_hypotheses import ScaleHypothesis as ScaleHypothesis
from .scale_hypotheses import region_held_out_rms as region_held_out_rms
from .scale_hypotheses import scale_hypotheses as scale_hypotheses
from .split_half import SplitHalfDifference as SplitHalfDifference
from .split_half import split_half_difference as split_half_difference
