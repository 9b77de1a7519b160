"""Fits that are made on one device by the tests, and on several by `fit_on_devices`."""

import numpy as np
from arms_scene import NOISE as ARMS_NOISE
from arms_scene import arms_scene
from starts import nudged

import smartview_jax as sv
from smartview_jax.engine.problem_builder import build_problem
from smartview_jax.simulation import paper_points, random_scene

NOISE = sv.Noise(0.15, 1e-4, 1e-4)
POINTS = paper_points((0.0, 0.02))[::6]


def scene():
    """Seven views do not go evenly into two."""
    return random_scene(2, 7, POINTS, translation_noise=1e-4)


def start():
    return nudged(scene().calibration)


def one_fit(devices):
    return sv.fit_joint(scene().data, start(), noise=NOISE, devices=devices)


def problem_without_corrections():
    return build_problem(scene().data, scene().calibration).problem


def described(fit):
    """What is compared of a fit, as plain numbers."""
    names = ["camera.alpha_u", *(f"camera_from_tool.translation.{axis}" for axis in "xyz")]
    return {
        "found": [
            float(fit.calibration.camera.alpha_u),
            *np.asarray(fit.calibration.camera_from_tool.translation()).tolist(),
        ],
        "std": [fit.std[name] for name in names],
        "corrections": np.asarray(fit.pose_corrections).tolist(),
        "cost": fit.solution.costs[-1],
        "converged": fit.result.converged,
    }


def sets():
    """Three, which do not go evenly into two devices."""
    return [random_scene(k, 7, POINTS).data for k in range(3)]


def many(devices):
    fits = sv.fit_many(sets(), start(), noise=NOISE, devices=devices)
    return np.asarray(fits.calibrations.camera.alpha_u).tolist()


def rig_fit(devices):
    """A camera on each of two arms in seven states, which see one target."""
    rig, truths = arms_scene(0, views=7)
    return sv.fit_rig(rig, truths, noise=ARMS_NOISE, field=None, devices=devices)


def described_rig(fit):
    """What is compared of the fit of a rig, as plain numbers."""
    base = fit.base("left", "right")
    hands = [fit.calibrations[name].camera_from_tool for name in fit.calibrations]
    return {
        "found": [np.asarray(pose.translation()).tolist() for pose in (base.transform, *hands)],
        "std": base.std.tolist(),
        "corrections": np.asarray(fit.pose_corrections).tolist(),
        "cost": fit.solution.costs[-1],
        "converged": fit.result.converged,
    }
