"""Compile the later steps of a calibration while its first steps run.

In a new process compilation takes far longer than the fits. XLA compiles without holding Python's
interpreter lock, so a second thread meanwhile runs the later steps on synthetic data of the same
shape.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxlie import SE3

from ..calibration import Calibration
from ..cameras import AbstractLens, Camera, Pinhole, initial_lens
from ..compilation import compiled
from ..dataset import Dataset
from ..staged import solve_hand_eye
from .fit import fit_joint

_precompiled: set[tuple] = set()


def precompile(
    data: Dataset, lens: str | AbstractLens, camera: Camera | None, options: dict
) -> None:
    """Run Step 3 and the joint fit once on synthetic data, unless this shape was run before."""
    key = (data.pixels.shape, data.mount, str(lens), camera is None, repr(sorted(options.items())))
    if key in _precompiled:
        return
    _precompiled.add(key)
    # Identical poses are enough: compilation depends on shapes, not on values.
    solve_hand_eye(data.base_from_tool, data.base_from_tool)
    width, height = data.image_size
    if camera is None:
        lens_model = initial_lens(lens, Pinhole())
        camera = Camera(width, width, width / 2.0, height / 2.0, lens_model, data.image_size)
    # Target one metre in front of the camera, so that every point can be projected.
    base_from_world = SE3.from_translation(jnp.array([0.0, 0.0, 1.0]))
    calibration = Calibration(camera, SE3.identity(), base_from_world, data.mount)
    poses = SE3(jnp.broadcast_to(SE3.identity().wxyz_xyz, data.base_from_tool.wxyz_xyz.shape))
    pixels, valid = compiled(calibration.project)(poses, data.points)
    synthetic = eqx.tree_at(
        lambda d: (d.pixels, d.visible, d.base_from_tool), data, (pixels, valid, poses)
    )
    fit_joint(synthetic, calibration, **options)
