"""An arm's axes, zeros and gears, from poses measured at known readings of its joints."""

from .kinematics import KinematicFit as KinematicFit
from .kinematics import fit_kinematics as fit_kinematics
