"""Provide data sets: the points of a target in pictures from several robot poses."""

from .dataset import MINIMUM_RELIABLE_VIEWS as MINIMUM_RELIABLE_VIEWS
from .dataset import Dataset as Dataset
from .input_checks import FORWARD_KINEMATICS_TOLERANCE as FORWARD_KINEMATICS_TOLERANCE
from .observations import Observations as Observations
from .observations import chain_residuals as chain_residuals
from .observations import medians_by_view as medians_by_view
from .observations import view_residuals as view_residuals
from .picture_digests import picture_digests as picture_digests
from .point_extents import coplanar as coplanar
from .point_extents import extents as extents
from .point_extents import mean_point as mean_point
from .point_extents import scatter as scatter
from .robot_motion import contradictory_views as contradictory_views
from .robot_motion import distinct_poses as distinct_poses
from .robot_motion import given_places as given_places
from .robot_motion import never_turns as never_turns
from .robot_motion import repeated_pose_reason as repeated_pose_reason
from .robot_motion import repeated_views as repeated_views
from .robot_motion import repetition_warnings as repetition_warnings
from .robot_motion import require_motion as require_motion
from .robot_motion import stale_poses as stale_poses
from .robot_motion import turns_about_one_axis as turns_about_one_axis
from .robot_motion import undetermined_twists as undetermined_twists
