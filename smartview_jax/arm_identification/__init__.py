"""Identify an arm's joint axes and gear ratios from poses measured at known joint readings."""

from .kinematics import KinematicFit as KinematicFit
from .kinematics import fit_kinematics as fit_kinematics
