"""Estimate the pose of an object from all that its pictures show of it, with its covariance.

Two estimators share their equations (`pose_equations`): from given matches of corners and segments,
and from the edge points along the visible wireframe, whose correspondences are renewed in every
step. Both weight the pictures' noise and what the calibration and the model contribute together, so
that an uncertain robot does not make one view contradict another.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from ..array_namespace import to_device
from ..engine import AbstractLoss, GemanMcClure
from ..features import EdgePoints
from ..geometry import host_exponentials
from ..modeling import CalibrationUncertainty, ObjectModel, SeenViews, pixel_jacobians
from .edge_lines import EdgeLines, lines_in_views
from .edge_lookup import EdgeLookup, padded_poses
from .match_equations import Matches, match_equations
from .pose_equations import (
    CommonErrors,
    PoseEquations,
    PoseStep,
    consistent_blocks,
    joined,
    solve_pose,
)
from .wireframe import Wireframe

MAX_STEPS = 20
"""Largest number of Gauss-Newton steps."""

CONVERGED = 1e-3
"""Length of a step, in standard deviations of the pose, below which the fit has ended."""

FINAL_RADIUS = 4.0
"""Search radius of edge points in the final fit, px: calibration errors move edges by some px."""

MAX_EDGE_SIGMA = 1.5
"""Largest standard deviation by which edges of pictures may differ from those of the model, px."""

FIT_SAMPLES = 1024
"""Number of points along all edges in the final fit: enough to meet almost every edge point."""
