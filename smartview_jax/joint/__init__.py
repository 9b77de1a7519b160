"""Fit camera, hand-eye transform, target pose and robot error to all pixels at once."""

from .camera_fit import CameraFit as CameraFit
from .camera_fit import batch_least_squares as batch_least_squares
from .camera_fit import fit_camera as fit_camera
from .fit import fit_joint as fit_joint
from .fit_text import estimate_groups as estimate_groups
from .fit_text import fit_html as fit_html
from .fit_text import fit_text as fit_text
from .influence import Influence as Influence
from .joint_fit import JointFit as JointFit
from .joint_fit import view_influence as view_influence
from .many import ManyFits as ManyFits
from .many import fit_many as fit_many
from .options import JointOptions as JointOptions
from .parameter_estimates import ParameterEstimate as ParameterEstimate
from .parameter_estimates import displayed_values as displayed_values
from .parameter_estimates import parameter_estimates as parameter_estimates
from .plausibility import MAX_ROTATION_HALF_WIDTH as MAX_ROTATION_HALF_WIDTH
from .plausibility import MAX_TRANSLATION_HALF_WIDTH as MAX_TRANSLATION_HALF_WIDTH
from .pose_fit import PoseFit as PoseFit
from .pose_fit import TrackerPrior as TrackerPrior
from .pose_fit import fit_poses as fit_poses
from .pose_fit import tracked_pose_errors as tracked_pose_errors
from .precompile import precompile as precompile
from .saved_estimate import SavedEstimate as SavedEstimate
from .saved_estimate import load_estimate as load_estimate
from .saved_estimate import load_with_uncertainty as load_with_uncertainty
