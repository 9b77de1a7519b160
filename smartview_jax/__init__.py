"""Calibrate a camera, its hand-eye transform and the robot's error in one differentiable fit.

The method is that of the paper "SmartView: Hand-Eye Robotic Calibration for Active Viewpoint
Generation and Object Grasping", which the other files call "the paper". Its staged pipeline is in
`staged`; the joint fit, which starts from the staged result, is in `joint`.

Conventions, kept by every function and file:

- a transform `target_from_source` maps points of `source` into `target`;
- metres, radians, pixels; the centre of the top-left pixel is (0, 0);
- the camera looks along +z, with x to the right and y down;
- tangents of rigid transforms are translation first, then rotation;
- the robot's error is a twist at the tool: `tool_from_base = exp(twist) @ reported`;
- float64: importing this package turns on JAX's x64 mode, because calibration is
  ill-conditioned in single precision.

Glossary:

- `target_from_source`: the name of every rigid transform, read from right to left. The point
  `p_target` is `target_from_source @ p_source`, as in `camera_from_tool` and `base_from_world`.
- pose: the position and orientation of one frame in another, as a rigid transform.
- twist: six numbers, translation (m) first and rotation (rad) last, whose exponential is a rigid
  transform; it describes small differences between two poses.
- hand-eye transform: the fixed pose of the camera on its mount, `camera_from_tool` for a camera
  on the hand and `camera_from_base` for one beside the arm.
- residual: measured minus predicted pixel, in u and in v.
- registration error: the mean distance between measured and predicted pixels, the paper's figure
  of merit; elsewhere called reprojection error.
- held-out error: the same distance on views that were not used by the fit.
- gross error: a measurement that is too far off to be noise, such as a wrongly detected corner;
  also called an outlier. Fits leave it out or limit its influence.
- robot error field: the twist between the reported and the actual pose of the tool as a smooth
  function of the reported pose or of the joint angles.
- effective pixel sigma: the standard deviation with which the pixels are weighted when a whole
  view is judged. It is not smaller than the standard deviation of the noise within a view,
  because the pixels of a real view err together.
"""

from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as _version

import jax as _jax

_jax.config.update("jax_enable_x64", True)

from . import cameras as cameras  # noqa: E402
from . import io as io  # noqa: E402
from . import robot_errors as robot_errors  # noqa: E402
from . import robots as robots  # noqa: E402
from . import simulation as simulation  # noqa: E402
from . import targets as targets  # noqa: E402
from . import viewpoints as viewpoints  # noqa: E402
from .arm_identification import fit_kinematics as fit_kinematics  # noqa: E402
from .calibration import Calibration as Calibration  # noqa: E402
from .calibration_pipeline import calibrate as calibrate  # noqa: E402
from .cameras import Camera as Camera  # noqa: E402
from .dataset import Dataset as Dataset  # noqa: E402
from .detection import correct_circle_centres as correct_circle_centres  # noqa: E402
from .engine import Noise as Noise  # noqa: E402
from .engine import Prior as Prior  # noqa: E402
from .evaluation import compare as compare  # noqa: E402
from .evaluation import cramer_rao as cramer_rao  # noqa: E402
from .evaluation import error_budget as error_budget  # noqa: E402
from .evaluation import held_out as held_out  # noqa: E402
from .evaluation import std_of as std_of  # noqa: E402
from .geometry import five_viewpoints as five_viewpoints  # noqa: E402
from .geometry import look_at as look_at  # noqa: E402
from .geometry import se3_from_xyzoat as se3_from_xyzoat  # noqa: E402
from .geometry import xyzoat as xyzoat  # noqa: E402
from .io import load_dataset as load_dataset  # noqa: E402
from .io import save_dataset as save_dataset  # noqa: E402
from .joint import JointFit as JointFit  # noqa: E402
from .joint import fit_camera as fit_camera  # noqa: E402
from .joint import fit_joint as fit_joint  # noqa: E402
from .joint import fit_many as fit_many  # noqa: E402
from .joint import view_influence as view_influence  # noqa: E402
from .staged import StagedFit as StagedFit  # noqa: E402
from .staged import fit_staged as fit_staged  # noqa: E402
from .viewpoints import choose_views as choose_views  # noqa: E402
from .viewpoints import viewpoint_commands as viewpoint_commands  # noqa: E402

try:
    __version__ = _version("smartview-jax")
except PackageNotFoundError:  # a checkout that was never installed has no metadata
    __version__ = "0+unknown"
