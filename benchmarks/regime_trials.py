"""The regimes of the map: what is simulated in each, who calibrates it, and how far off they are.

White regimes have the paper's lens and distance, a board in one plane, and a robot that errs by
chance alone, so that the joint fit's model is true. In the arm's, joints, links and twists of a
6R arm are not what its controller believes, the lens bends more than its model, and the board is
warped: no model is true. A method is judged by the true pixels of views that it never saw.

All data sets of a kind are padded to one shape with views and points that nobody sees, so that
every program is compiled once for the whole map.
"""

import dataclasses
from collections.abc import Callable, Collection
from typing import Any, Literal, NamedTuple

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

import smartview_jax as sv
from smartview_jax.evaluation import CramerRaoBound, reprojection_errors
from smartview_jax.robots import CommandLike
from smartview_jax.simulation import paper_calibration, random_scene, six_axis_scene
from smartview_jax.simulation.arm_scenes import KINEMATIC_ERROR_SIGMA

from .peers.hand_eye import HAS_VISION_CALIBRATION, opencv_park, vision_calibration

VIEWS, POINTS, UNSEEN = 25, 90, 40
"""The shape that white regimes are padded to, and the views that they are judged on."""

STAGED, TRUSTED, WHITE = "staged", "joint, robot trusted", "joint, white noise"
DEFAULT, KNOWN_ARM = "joint, default", "joint, joints known"
PARK = "OpenCV, Park"

Method = Callable[[sv.Dataset], sv.Calibration]


@dataclasses.dataclass(frozen=True)
class Regime:
    """One row of the map: a robot with white noise, or, with `errors`, the 6R arm.

    Attributes:
        axis: what is varied.
        name: of the regime, one of its own.
        views: to calibrate with.
        grid: rows and columns of points.
        pixel: noise, px.
        translation: noise of reported poses, mm.
        rotation: noise of reported poses, degrees.
        tilt: of the views, at most, degrees.
        errors: of the arm, as multiples of the usual ones; None for a robot that has none.
        seeds: runs, if no other number is asked for.
    """

    axis: str
    name: str
    views: int = 15
    grid: tuple[int, int] = (9, 10)
    pixel: float = 0.15
    translation: float = 0.1
    rotation: float = 0.01
    tilt: float = 35.0
    errors: float | None = None
    seeds: int = 8

    @property
    def noise(self) -> sv.Noise:
        """True sizes of all errors; an arm's own are those it was drawn from."""
        field = (
            ()
            if self.errors is None
            else tuple(self.errors * e for e in KINEMATIC_ERROR_SIGMA.values())
        )
        turn = float(np.deg2rad(self.rotation))
        return sv.Noise(self.pixel, 1e-3 * self.translation, turn, field=field)


class Trial(NamedTuple):
    """One simulated experiment.

    Attributes:
        data: to calibrate with.
        unseen: what other views truly show.
        truth: the calibration.
        by_joints: both sets from a robot that reports its joint angles; None for others.
    """

    data: sv.Dataset
    unseen: sv.Dataset
    truth: sv.Calibration
    by_joints: tuple[sv.Dataset, sv.Dataset] | None = None


def simulated(regime: Regime, seed: int) -> Trial:
    """The experiment of a seed; regimes share viewpoints as far as they can."""
    noise = regime.noise
    size: dict[str, Any] = {
        "translation_noise": noise.translation,
        "rotation_noise": noise.rotation,
    }
    if regime.errors is not None:
        scene = six_axis_scene(seed, VIEWS, UNSEEN, regime.errors, pixel_noise=noise.pixel, **size)
        shown = range(regime.views)
        told = scene.with_joint_readings
        pair = _padded(told.data.select(shown), VIEWS, told.data.points.shape[1]), told.held_out
        data = _padded(scene.data.select(shown), VIEWS, scene.data.points.shape[1])
        return Trial(data, scene.held_out, scene.calibration, pair)
    i, j = np.indices(regime.grid).reshape(2, -1)
    rows, columns = (max(n - 1, 1) for n in regime.grid)
    board = np.stack([0.036 * j / columns, 0.030 * i / rows, np.zeros(len(i))], axis=1)
    options: dict[str, Any] = {"points": board, "tilt": np.deg2rad(regime.tilt)}
    scene = random_scene(seed, regime.views, pixel_noise=noise.pixel, **options, **size)
    unseen = random_scene(10_000 + seed, UNSEEN, pixel_noise=0.0, **options).data
    data, unseen = _padded(scene.data, VIEWS, POINTS), _padded(unseen, UNSEEN, POINTS)
    return Trial(data, unseen, paper_calibration())


def _padded(data: sv.Dataset, views: int, points: int) -> sv.Dataset:
    """Add views and points that nobody sees; poses are repeated in turn."""
    more = ((0, views - data.view_count), (0, points - data.points.shape[1]), (0, 0))
    order = np.arange(views) % data.view_count
    return dataclasses.replace(
        data,
        points=jnp.pad(data.points, more, mode="edge"),
        pixels=jnp.pad(data.pixels, more, constant_values=jnp.nan),
        visible=jnp.pad(data.visible, more[:2]),
        base_from_tool=SE3(data.base_from_tool.wxyz_xyz[order]),
        view_ids=tuple(map(str, range(views))),
        joints=None if data.joints is None else data.joints[order],
    )


def methods(regime: Regime) -> dict[str, Method]:
    """Who calibrates, by name; those that are told the joints have a robot that tells them.

    The peers bring their own lens, OpenCV's with four numbers (vision-calibration: five), where
    the paper's has one: what that costs them is part of their result.
    """
    lens = "radial" if regime.errors is None else "opencv4"

    def staged(data: sv.Dataset) -> sv.Calibration:
        return sv.fit_staged(data, lens).calibration

    def joint(noise: str, field: Literal["auto"] | None = "auto") -> Method:
        options: dict[str, Any] = {"noise": noise, "field": field}
        return lambda data: sv.fit_joint(data, staged(data), **options).calibration

    found: dict[str, Method] = {
        STAGED: staged,
        TRUSTED: joint("trusted"),
        WHITE: joint("estimated", field=None),
        DEFAULT: joint("estimated"),
    }
    if regime.errors is not None:
        found[KNOWN_ARM] = joint("estimated")
    found[PARK] = opencv_park
    found["Park + bundle, K held"] = _park_and_bundle
    if HAS_VISION_CALIBRATION:
        found["vision-calibration"] = lambda data: vision_calibration(data, True)
        found["  poses not refined"] = lambda data: vision_calibration(data, False)
    return found


def _park_and_bundle(data: sv.Dataset) -> sv.Calibration:
    """OpenCV's camera held, its hand-eye and world refined by all pixels at once."""
    start = opencv_park(data)
    return sv.fit_joint(data, start, noise="trusted", fixed=("camera",)).calibration


def one_run(regime: Regime, seed: int, names: Collection[str]) -> dict[str, Any]:
    """Methods on one experiment: px and what the bound is of it, hand-eye mm and degrees."""
    trial = simulated(regime, seed)
    errors = {
        name: _judged(method, trial, name == KNOWN_ARM)
        for name, method in methods(regime).items()
        if name in names
    }
    return {"bound": _least_error(regime, trial), "methods": errors}


def _judged(method: Method, trial: Trial, by_joints: bool) -> dict[str, Any]:
    data, unseen = trial.by_joints if by_joints and trial.by_joints else trial[:2]
    try:
        found = method(data)
    except (ValueError, RuntimeError, cv2.error) as error:
        return {"failed": str(error)}
    seen = reprojection_errors(found, unseen)
    if seen.unpredicted_count or not np.isfinite(seen.rms):
        return {"failed": f"{seen.unpredicted_count} points cannot be predicted"}
    error = found.camera_from_tool.inverse() @ trial.truth.camera_from_tool
    turn = np.linalg.norm(np.asarray(error.rotation().log()))
    shift = found.camera_from_tool.translation() - trial.truth.camera_from_tool.translation()
    return {
        "px": seen.rms,
        "mm": 1e3 * float(jnp.linalg.norm(shift)),
        "deg": float(np.rad2deg(turn)),
    }


class _Places(eqx.Module):
    """Where a calibration sees points: one function for every trial, so compiled once."""

    command: CommandLike
    points: Array

    def __call__(self, calibration: sv.Calibration) -> Float[Array, "views points 2"]:
        return calibration.project(self.command, self.points)[0]


def _least_error(regime: Regime, trial: Trial) -> float:
    """RMS px on the unseen views that an efficient estimator has, who is told all sizes.

    The arm's is told the joints too, and has neither a warped board nor a lens it does not know.
    """
    data, unseen = trial.by_joints or trial[:2]
    error = trial.truth.robot_error
    bound: CramerRaoBound = sv.cramer_rao(
        trial.truth, data, regime.noise, field=None if error is None else error.field
    )
    std = sv.std_of(bound, _Places(unseen.command, unseen.points))
    return float(
        np.sqrt(np.mean(np.sum(np.asarray(std) ** 2, axis=-1)[np.asarray(unseen.visible)]))
    )
