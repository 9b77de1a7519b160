"""Collect what is known before views are planned: a calibration, or rough transforms."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..calibration import Calibration, transform_names
from ..cameras import Camera, Pinhole
from ..dataset import DepthNoise, require_picture_size
from ..geometry import host_matrices
from ..joint import SavedEstimate
from ..robots import JointsLike
from .information_model import InformationModel
from .next_views import (
    TYPICAL_NOISE,
    first_view_distances,
    model_from_estimate,
    with_assumed_region,
)
from .view_range import ViewRange

ASSUMED_FOCAL_LENGTH = 1.2
"""Focal length of an unknown camera, relative to the picture's longer side."""

FIRST_BORDER = 0.1
"""Margin of first views, relative to the shorter side, for errors of the rough transforms."""

DISTANCE_MARGIN = 0.1
"""Widening of the calibrated distances on either side: views at one distance leave no range."""

MIN_FLATNESS = 0.5
"""Smallest vertical component of a target's normal for a target that lies rather than hangs."""


class ViewLimits(NamedTuple):
    """The limits of views that the user set.

    Attributes:
        distance: smallest and largest distance from the target, m; None to choose them.
        tilt: largest tilt, rad.
        roll: largest roll, rad.
        below: whether to look from where the world's z is negative; None to infer the side.
    """

    distance: tuple[float, float] | None = None
    tilt: float = float(np.deg2rad(40.0))
    roll: float = float(np.deg2rad(90.0))
    below: bool | None = None


class Situation(NamedTuple):
    """The state of knowledge before the views of a plan are taken.

    Attributes:
        calibration: the calibration, or a rough one.
        model: information about its parameters, and the information that a view adds.
        points: the target's points, m.
        views: range of the views.
        border_margin: width of the picture's border that has to stay free, px.
        assumptions: what was assumed, in sentences.
    """

    calibration: Calibration
    model: InformationModel
    points: Float[np.ndarray, "points 3"]
    views: ViewRange
    border_margin: float
    assumptions: tuple[str, ...]


def situation_of_estimate(
    estimate: SavedEstimate,
    points: Float[np.ndarray, "points 3"],
    limits: ViewLimits,
    readings: JointsLike | None = None,
    depth_noise: DepthNoise | None = None,
) -> Situation:
    """Return the situation given a calibration with its covariance.

    Args:
        points: the target's points, m.
        readings: joint readings now, if the arm's joints are calibrated.
        depth_noise: noise of the depths that every view has; None without a depth sensor.

    Raises:
        ValueError: the calibration states no region, which files of earlier versions lack.
    """
    model = model_from_estimate(estimate, points, readings, depth_noise)
    views = views_near_calibrated(estimate.calibration, points, limits)
    return Situation(estimate.calibration, model, points, views, 0.0, ())


def views_near_calibrated(
    calibration: Calibration, points: Float[np.ndarray, "points 3"], limits: ViewLimits
) -> ViewRange:
    """Return the range of new views of a camera, which stay near the calibrated ones."""
    region = calibration.region
    if region is None:
        raise ValueError("region: missing; calibrate again to add it")
    near, far = (float(x) for x in np.asarray(region.distance_range))
    below = limits.below
    above = bool(float(region.side) >= 0.0) if below is None else not below
    widened = ((1.0 - DISTANCE_MARGIN) * near, (1.0 + DISTANCE_MARGIN) * far)
    return _view_range(points, limits, widened, above)


def situation_of_drawing(
    transforms: Mapping[str, SE3],
    mount: str,
    points: Float[np.ndarray, "points 3"],
    image_size: tuple[int, int],
    camera: Camera | None,
    limits: ViewLimits,
) -> Situation:
    """Return the situation given rough transforms, before any picture is taken.

    Args:
        transforms: the rough poses of camera and target, by name.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        points: the target's points, m.
        image_size: width and height of the pictures, px.
        camera: a known camera; None for one that is assumed.

    Raises:
        ValueError: a missing transform, a camera with pictures of another size, or an unknown side
            of the target.
    """
    mount_name, holder_name = transform_names(mount)
    for name in (mount_name, holder_name):
        if name not in transforms:
            raise ValueError(f"--start {name}=x,y,z,yaw,pitch,roll (m, degrees): missing")
    assumptions = []
    # The field of view of many cameras is about 45 degrees; the border margin covers the others.
    known = camera is not None
    if camera is None:
        width, height = image_size
        focal = ASSUMED_FOCAL_LENGTH * max(width, height)
        camera = Camera(
            focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), Pinhole(), (width, height)
        )
        assumptions.append(f"camera not known: a focal length of {focal:.0f} px is assumed")
    else:
        require_picture_size("--camera", camera, image_size)
    # Nothing is fitted here: errors of centimetres show in the first picture.
    rough = Calibration(camera, transforms[mount_name], transforms[holder_name], mount)
    above = _side(rough, limits.below)
    distances = limits.distance or first_view_distances(rough, points)
    # The checks of commands need to know on which side of the target the robot may be.
    rough = with_assumed_region(rough, points, distances, above)
    # No prior: the views are to determine the parameters that are rough.
    model = InformationModel.from_calibration(
        rough, points, TYPICAL_NOISE, fixed=("camera",) if known else ()
    )
    noise = TYPICAL_NOISE
    assumptions.append(
        f"assumed errors: {noise.pixel:g} px, {1e3 * noise.translation:g} mm and "
        f"{np.rad2deg(noise.rotation):g} degrees of the robot; the transforms are rough: go slowly"
    )
    views = _view_range(points, limits, distances, above)
    margin = FIRST_BORDER * min(image_size)
    return Situation(rough, model, points, views, margin, tuple(assumptions))


def _side(rough: Calibration, below: bool | None) -> bool:
    """Return whether the first views look from where the world's z is positive."""
    if below is not None:
        return not below
    up = float(host_matrices(rough.holder_from_world)[2, 2])
    # A target that lies flat is seen from above; one that hangs may face anywhere.
    if rough.mount != "eye_in_hand" or abs(up) < MIN_FLATNESS:
        raise ValueError(
            "from which side is the target seen? Give --above if its z axis points to the camera, "
            "--below if it points away (as a chessboard's does)"
        )
    return up > 0.0


def _view_range(
    points: Float[np.ndarray, "points 3"],
    limits: ViewLimits,
    distances: tuple[float, float],
    above: bool,
) -> ViewRange:
    """Return the range of views about the middle of the target."""
    # The option takes precedence over distances of the calibration or from the target's size.
    span = limits.distance or distances
    return ViewRange(points.mean(axis=0), span, limits.tilt, limits.roll, above=above)
