"""The joint fit: one least-squares problem from the arm to the pixel."""

from .build import build_problem as build_problem
from .calibrate import CalibrationFit as CalibrationFit
from .calibrate import calibrate as calibrate
from .camera_fit import CameraFit as CameraFit
from .camera_fit import batch_filter as batch_filter
from .camera_fit import fit_camera as fit_camera
from .estimate import Alternative as Alternative
from .estimate import NoiseEstimate as NoiseEstimate
from .estimate import estimate_noise as estimate_noise
from .fit import JointFit as JointFit
from .fit import fit_joint as fit_joint
from .losses import AbstractLoss as AbstractLoss
from .losses import Cauchy as Cauchy
from .losses import GemanMcClure as GemanMcClure
from .losses import Huber as Huber
from .losses import StudentT as StudentT
from .many import ManyFits as ManyFits
from .many import fit_many as fit_many
from .noise import Noise as Noise
from .observability import Observability as Observability
from .parameters import parameter_names as parameter_names
from .priors import Prior as Prior
from .problem import JointProblem as JointProblem
from .solver import StructuredLM as StructuredLM
from .solver import optimum as optimum
