"""Estimate the standard deviations of all errors by restricted likelihood, over several models."""

from .depth_weights import with_weighed_depths as with_weighed_depths
from .kenward_roger import joined_corrections as joined_corrections
from .kenward_roger import p_value as p_value
from .model_comparison import compare_models as compare_models
from .model_selection import WHITE_NOISE as WHITE_NOISE
from .model_selection import ModelName as ModelName
from .model_selection import encompassing_field as encompassing_field
from .noise_estimate import CandidateResult as CandidateResult
from .noise_estimate import NoiseEstimate as NoiseEstimate
from .noise_estimate import TargetScaleEvidence as TargetScaleEvidence
from .noise_estimate import TargetShapeEstimate as TargetShapeEstimate
from .pose_variances import DEPTH_AXES as DEPTH_AXES
from .pose_variances import DepthAxis as DepthAxis
from .pose_variances import LinearPairs as LinearPairs
from .pose_variances import LogNormalPriors as LogNormalPriors
from .pose_variances import Poses as Poses
from .pose_variances import likeliest_variances as likeliest_variances
from .pose_variances import linear_pairs as linear_pairs
from .pose_variances import moved_transforms as moved_transforms
from .pose_variances import pose_differences as pose_differences
from .rig_noise import RigNoiseEstimate as RigNoiseEstimate
from .rig_noise import estimate_rig_noise as estimate_rig_noise
from .robot_evidence import RobotEvidence as RobotEvidence
from .robot_evidence import SizesOfErrors as SizesOfErrors
from .variance_components import estimate_noise as estimate_noise
