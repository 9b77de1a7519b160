from .kinematics import KinematicFit as KinematicFit
from .kinematics import fit_kinematics as fit_kinematics
