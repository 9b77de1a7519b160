"""Simulate the paper's experiment (Table 1, Figs. 6 and 7) with known truth.

A 1/3 inch CCD (640 x 480 px) with a 16 mm lens (2133 px) views circles 6 mm apart, on three
heights, from 0.2 m. Five viewpoints form a cross: one from above, and two each, 9.5 degrees away,
along X and along Y, all without roll. Held-out viewpoints lie between the five.

The paper's text states only this. The rest is chosen to reproduce all three rows of its Table 1: a
strong lens distortion (k1 = 0.7), a robot with white noise of 0.08 mm and 0.01 degrees in every
pose, including the held-out ones, and viewpoints whose point of aim has an error of 0.25 mm per
axis. The last is an independent assumption: without it the viewpoints are so regular that
interpolation between them is too accurate, 1.6 px instead of the paper's 4.2.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..calibration import Calibration
from ..geometry import (
    FIVE_VIEWPOINT_PATTERNS,
    FIVE_VIEWPOINT_STEP,
    five_viewpoints,
    look_at,
    viewing_direction,
)
from ..targets import CircleGrid, StackedTarget
from .rendered_scenes import rendered_scene
from .scenes import Scene, paper_calibration, reported_poses, simulate

DISTANCE = 0.2
"""Distance from a camera to its point of aim, m."""


class PaperSetUp(NamedTuple):
    """The parameters of the paper's experiment; `PaperSetUp(k1=0.3)` changes one of them.

    Attributes:
        pattern: arrangement of the five viewpoints: `"cross"`, or `"L"`: 9.5 and 19 degrees along X
            and Y.
        roll: largest rotation of a viewpoint about its optical axis, in either direction, rad.
        aim_sigma: standard deviation of a viewpoint's point of aim, per axis, m.
        k1: radial distortion coefficient of the lens.
        columns, rows: number of circles along X and along Y.
        spacing: distance between circles, m.
        heights: positions of the board along Z, m.
        radius: radius of the circles in pictures, m.
        pixel_noise: standard deviation of `u` and of `v`, px; rendered pictures have their own
            noise.
        translation_noise, rotation_noise: noise of the robot, as in `simulate`, m and rad.
    """

    pattern: str = "cross"
    roll: float = 0.0
    aim_sigma: float = 2.5e-4
    k1: float = 0.7
    columns: int = 10
    rows: int = 8
    spacing: float = 0.006
    heights: tuple[float, ...] = (0.0, 0.01, 0.02)
    radius: float = 0.002
    pixel_noise: float = 0.15
    translation_noise: float = 8e-5
    rotation_noise: float = float(np.deg2rad(0.01))

    @property
    def calibration(self) -> Calibration:
        """The true calibration."""
        return eqx.tree_at(lambda c: c.camera.lens.k1, paper_calibration(), jnp.asarray(self.k1))

    @property
    def target(self) -> StackedTarget:
        """The circle grid, whose circle centres are the target points."""
        board = CircleGrid(self.rows, self.columns, self.spacing, radius=self.radius)
        return StackedTarget(board, self.heights)


PAPER_SETUP = PaperSetUp()
"""The parameters of the paper's own experiment."""

RENDERED_PAPER_SETUP = PaperSetUp(columns=9, rows=7)
"""The experiment with the largest board that is entirely visible in every picture."""


def paper_viewpoints(rng: np.random.Generator, setup: PaperSetUp = PAPER_SETUP) -> SE3:
    """Return `camera_from_world`, `(5)`, of the paper's viewpoints."""
    roll, aims = _random_rolls_and_aims(rng, setup, 5)
    return five_viewpoints(aims, DISTANCE, roll, pattern=setup.pattern)


def _random_rolls_and_aims(
    rng: np.random.Generator, setup: PaperSetUp, views: int
) -> tuple[Float[np.ndarray, "views"], Float[np.ndarray, "views 3"]]:
    """Return random roll angles and random points of aim."""
    aims = setup.aim_sigma * rng.standard_normal((views, 3)) + setup.target.points.mean(axis=0)
    return rng.uniform(-setup.roll, setup.roll, views), aims


def paper_scene(seed: int = 0, setup: PaperSetUp = PAPER_SETUP) -> Scene:
    """Return the paper's experiment, simulated from points, without pictures.

    There are about 1200 circles over the five viewpoints.
    """
    rng = np.random.default_rng((seed, 1))
    return _simulate_scene(paper_viewpoints(rng, setup), setup, seed)


def paper_held_out(seed: int = 0, setup: PaperSetUp = PAPER_SETUP, views: int = 60) -> Scene:
    """Return held-out views from between the paper's five viewpoints, without pixel noise.

    They fill the convex hull of the five uniformly; their errors of aim and the robot's errors have
    the same standard deviations as for the five.
    """
    rng = np.random.default_rng((seed, 2))
    max_offset = np.sin(FIVE_VIEWPOINT_STEP * np.max(FIVE_VIEWPOINT_PATTERNS[setup.pattern]))
    # Uniform over the triangle between the middle and two neighbouring ends, then over all such
    # triangles by random signs.
    direction_offsets = max_offset * rng.dirichlet([1.0, 1.0, 1.0], views)[:, :2]
    if setup.pattern == "cross":
        direction_offsets = direction_offsets * rng.choice([-1.0, 1.0], direction_offsets.shape)
    roll, aims = _random_rolls_and_aims(rng, setup, views)
    # The offsets are the x and y components of the unit viewing direction: sin(tilt) times the
    # cosine and the sine of the azimuth.
    tilt = np.arcsin(np.hypot(*direction_offsets.T))
    azimuth = np.arctan2(direction_offsets[:, 1], direction_offsets[:, 0])
    poses = look_at(aims, viewing_direction(tilt, azimuth), DISTANCE, roll)
    return _simulate_scene(poses, setup._replace(pixel_noise=0.0), seed + 1_000_000)


def _simulate_scene(poses: SE3, setup: PaperSetUp, seed: int) -> Scene:
    """Return a simulated scene of viewpoints with the noise of the set-up."""
    truth = setup.calibration
    return simulate(
        truth,
        truth.command_for(poses),
        setup.target.points,
        seed=seed,
        pixel_noise=setup.pixel_noise,
        translation_noise=setup.translation_noise,
        rotation_noise=setup.rotation_noise,
    )


def paper_rendered_scene(
    seed: int = 0,
    setup: PaperSetUp = RENDERED_PAPER_SETUP,
    progress: Callable[[str], None] | None = None,
) -> Scene:
    """Return the paper's experiment with circles that are detected in rendered pictures."""
    truth, rng = setup.calibration, np.random.default_rng((seed, 3))
    poses = truth.command_for(paper_viewpoints(np.random.default_rng((seed, 1)), setup))
    # A separate generator for the robot's noise, so that the viewpoints are the same as in
    # `paper_scene`.
    reported = reported_poses(poses, rng, setup.translation_noise, setup.rotation_noise)
    return rendered_scene(truth, poses, setup.target, reported, seed, progress, samples=2)
