"""Fit camera, hand-eye transform, target pose and robot error to all pixels at once."""

from ..moved import moved as _moved
from .camera_fit import CameraFit as CameraFit
from .camera_fit import batch_filter as batch_filter
from .camera_fit import fit_camera as fit_camera
from .fit import JointFit as JointFit
from .fit import fit_joint as fit_joint
from .fit import view_influence as view_influence
from .influence import Influence as Influence
from .many import ManyFits as ManyFits
from .many import fit_many as fit_many
from .plausibility import COARSE_ROTATION as COARSE_ROTATION
from .plausibility import COARSE_TRANSLATION as COARSE_TRANSLATION
from .rehearsal import rehearse as rehearse

_PLACES = {
    "engine": """
        AbstractLoss Cauchy GemanMcClure Huber JointProblem Noise Observability Prior StructuredLM
        StudentT build_problem optimum parameter_names
    """,
    "variance": "Alternative NoiseEstimate estimate_noise",
    "arm_identification": "KinematicFit fit_kinematics",
    "calibrate_data": "CalibrationFit best_uncorrected calibrate",
}

# `arm_identification` and `calibrate_data` are higher layers. They are imported only when an old
# name is requested, which avoids a circular import.
__getattr__ = _moved(
    __name__,
    {name: f"smartview_jax.{room}" for room, names in _PLACES.items() for name in names.split()},
)
