"""Weigh depths against pixels: find the noise of pixels within views, with which depths count.

Depths have a known standard deviation in metres (`dataset.DepthNoise`), pixels an unknown one in
px. Both are scaled together afterwards: where views as a whole scatter more than their points
(effective pixel sigma), their depths are trusted less as well.
"""

import dataclasses

import numpy as np

from ..calibration import Calibration, flat_shape
from ..dataset import Dataset
from ..engine import Noise, ParameterChoice, build_problem
from ..robot_errors import FieldChoice
from .free_poses import fit_free_poses
from .model_selection import encompassing_field
from .view_statistics import SIGMA_FLOOR, chain_at

LARGEST_RATIO = 2.0
"""Largest ratio of measured and predicted depths: beyond it they have another unit or origin."""


def with_weighed_depths(
    data: Dataset, start: Calibration, choice: ParameterChoice, field: FieldChoice = "auto"
) -> Dataset:
    """Return the data with depths that count relative to the noise of pixels within views.

    Args:
        data: data set; one without depths, or with weighed ones, is returned as it is.
        start: a calibration near the solution, with the lens to fit.
        choice: parameters that are held, free, and with priors.
        field: robot error field, with which later fits share a program.

    Raises:
        ValueError: depths that are far from where the pixels put the target.
    """
    if data.depths is None or np.asarray(data.depths.pixel_sigma).any():
        return data
    usable = data.usable_views()
    basis = encompassing_field(data, len(usable)) if field == "auto" else field
    groups = () if basis is None else basis.groups
    # Without priors of the poses depths have no weight yet (see `build_problem`).
    free = Noise(1.0, np.inf, np.inf, field=(1.0,) * len(groups))
    choice = choice.holding("depth_bias")
    built = build_problem(data, start, noise=free, field=basis, **choice._asdict())
    shape = flat_shape(np.asarray(data.points), np.asarray(data.visible))
    fit = fit_free_poses(built, usable, shape)
    parameters = built.pose_parameters(usable) + int(
        np.sum(np.asarray(built.problem.is_camera)[np.asarray(built.problem.free)])
    )
    freedom = max(2 * fit.problem.visible_count - parameters, 1)
    sigma = max(float(np.sqrt(fit.sum_of_squares / freedom)), SIGMA_FLOOR)
    poses = np.asarray(chain_at(fit.problem, fit.z).camera_from_world)
    _refuse_other_unit(data, poses)
    return dataclasses.replace(data, depths=data.depths.relative_to(sigma))


def _refuse_other_unit(data: Dataset, camera_from_world: np.ndarray) -> None:
    """Raise a ValueError for depths far from where the pixels put the target."""
    assert data.depths is not None
    used = data.depths.used & np.asarray(data.visible)
    placed = np.einsum("vk,vpk->vp", camera_from_world[:, 2, :3], np.asarray(data.points))
    predicted = (placed + camera_from_world[:, 2, 3, None])[used]
    if not len(predicted):
        return
    measured, expected = np.median(np.asarray(data.depths.measured)[used]), np.median(predicted)
    if not 1.0 / LARGEST_RATIO < measured / expected < LARGEST_RATIO:
        raise ValueError(
            f"depths: expected about {expected:.3g} m, where the pixels put the target, found "
            f"{measured:.3g} (medians): are they metres along the optical axis?"
        )
