"""Compile the joint fit's programs before they are needed, for data of a given shape.

In a new process compilation takes far longer than the fits. XLA compiles without holding Python's
interpreter lock, so a second thread can do it while the first steps of a calibration run.
"""

from collections.abc import Hashable
from typing import Any

import jax
import numpy as np

from ..calibration import Calibration
from ..cameras import AbstractLens, Camera, Pinhole, initial_lens
from ..dataset import Dataset
from ..engine import Noise, Prior, build_problem, solve
from ..geometry import host_transforms
from ..robot_errors import FieldChoice
from ..runtime.padding import padded_counts
from ..variance import MIN_GENERIC_ARM_VIEWS, encompassing_field

_precompiled: set[Hashable] = set()
"""The kinds of data and options for which this process has precompiled."""


def needs_precompiling(data: Dataset, *options: Any) -> bool:
    """Return whether this is the first call in this process for data and options of this kind.

    It may err, since it tells kinds apart by what is cheap to look at: an error costs time only.

    Args:
        data: the data set to be fitted.
        options: what `precompile` is given with it.
    """
    kind = (
        type(data),
        padded_counts(*data.visible.shape),
        # More views have more models of the robot's errors.
        len(data.usable_views()) < MIN_GENERIC_ARM_VIEWS,
        data.mount,
        *(jax.tree.structure(part) for part in (data.arm, data.joints, data.depths, data.hands)),
        *(x if isinstance(x, str) else jax.tree.structure(x) for x in options),
    )
    is_new = kind not in _precompiled
    _precompiled.add(kind)
    return is_new


def precompile(
    data: Dataset,
    lens: str | AbstractLens,
    *,
    camera: Camera | None = None,
    noise: str | Noise = "estimated",
    field: FieldChoice = "auto",
) -> None:
    """Compile the programs of `fit_joint` for data of this shape; a second call takes milliseconds.

    Args:
        data: a data set with the same number of views and points, and the same kind of robot, as
            the data to be fitted.
        lens: lens model of the fit.
        camera: a known camera, with its own lens.
        noise, field: as for `fit_joint`.

    For example:

        >>> sv.precompile(data, "radial", noise=noise)  # may run while pictures are still taken
        >>> joint = sv.fit_joint(data, truth, noise=noise)
    """
    if camera is None:
        width, height = data.image_size
        lens_model = initial_lens(lens, Pinhole())
        camera = Camera(width, width, width / 2.0, height / 2.0, lens_model, data.image_size)
    noise_model = noise
    if noise == "estimated":
        if field == "auto":
            field = encompassing_field(data, len(data.usable_views()))
        noise_model = Noise(1.0, 1.0, 1.0).with_unit_groups(field)
    identity = host_transforms(np.eye(4))
    # A fit without visible points ends at once, at the priors; only the array shapes matter.
    problem = build_problem(
        data.with_visible(np.zeros(data.visible.shape, dtype=bool)),
        Calibration(
            camera, identity, identity, data.mount, base_from_other_base=data.base_from_other_base
        ),
        noise=noise_model,
        field=field,
        priors={"camera": Prior(std=1.0)},
    ).problem
    solve(problem)
