"""Calibrate a camera, its hand-eye transform and the robot's error in one differentiable fit.

The method comes from the paper "SmartView: Hand-Eye Robotic Calibration for Active Viewpoint
Generation and Object Grasping", which the other files call "the paper". Its staged pipeline is in
`staged`; the joint fit, which starts from the staged result, is in `joint`.

Conventions, kept by every function and file:

- a transform `target_from_source` maps points of `source` into `target`;
- metres, radians, pixels; the centre of the top-left pixel is (0, 0);
- the camera looks along +z, with x to the right and y down;
- tangents of rigid transforms are translation first, then rotation;
- the robot's error is a twist at the tool: `tool_from_base = exp(twist) @ reported`;
- float64: importing this package turns on JAX's x64 mode, because calibration is
  ill-conditioned in single precision (see `double_precision`); after it is turned off again,
  every fit raises an error.

The first fit takes longest, because its programs are compiled. They are kept on disk, by default in
~/.cache/smartview_jax, and later processes read them; `compilation_cache` explains how to choose
another folder or to turn this off.

Glossary:

- `target_from_source`: the name of every rigid transform, read from right to left. The point
  `p_target` is `target_from_source @ p_source`, as in `camera_from_tool` and `base_from_world`.
- pose: the position and orientation of one frame in another, as a rigid transform.
- twist: six numbers, translation (m) first and rotation (rad) last, whose exponential is a rigid
  transform; it describes small differences between two poses.
- hand-eye transform: the fixed pose of the camera on its mount, `camera_from_tool` for a camera
  on the hand and `camera_from_base` for a fixed camera.
- residual: measured minus predicted pixel, in u and in v.
- registration error: the mean distance between measured and predicted pixels, the paper's figure
  of merit; elsewhere called reprojection error.
- held-out error: the same distance on views that were not used by the fit.
- gross error: a measurement too far off to be noise, such as a wrongly detected corner; also
  called an outlier. Fits leave it out or limit its influence.
- robot error field: the twist between the reported and the actual pose of the tool as a smooth
  function of the reported pose or of the joint angles.
- effective pixel sigma: the standard deviation with which the pixels are weighted when a whole
  view is judged. It is not smaller than the standard deviation of the noise within a view,
  because the pixels of a real view err together.

Every public name has an example in its docstring. The examples continue this one, which simulates
eight views by the paper's camera and calibrates from them:

    >>> import numpy as np
    >>> import smartview_jax as sv
    >>> points = sv.simulation.paper_points(heights=(0.0, 0.02))[::6]
    >>> noise = sv.Noise(pixel=0.15, translation=1e-4, rotation=2e-4)
    >>> scene = sv.simulation.random_scene(
    ...     seed=0, views=8, points=points, translation_noise=1e-4, rotation_noise=2e-4
    ... )
    >>> data, truth = scene.data, scene.calibration
    >>> fit = sv.calibrate(data, "radial", noise=noise)

With pictures of your own: `data = sv.load_dataset("my_folder")` and `fit = sv.calibrate(data)`.
"""

import lazy_loader as _lazy_loader

from .runtime.double_precision import enable_double_precision as _enable_double_precision

_enable_double_precision()

# `__init__.pyi` lists the public names and their modules, for type checkers and editors too. Each
# name is imported when it is first used.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
