"""The paper's experiment from pictures: Table 1 and the stylus test (Fig. 2).

The set-up of `table1`, with 9 x 7 circles of 2 mm radius, which stay in every picture as a
whole: the pictures are rendered and the circles detected in them. Table 1 judges 60 unseen
viewpoints against the true pixels of the circles' centres. For the stylus test the tip of a tool is
sent to the world's origin, as each calibration has it, by a robot without noise and by the same
robot. Interpolation has no hand-eye transform, so it can command nothing.
"""

import sys

import numpy as np
from jaxlie import SO3

import smartview_jax as sv
from smartview_jax.evaluation import Predictor, stylus_error, touching_pose
from smartview_jax.simulation import (
    RENDERED_PAPER_SETUP,
    Scene,
    paper_held_out,
    paper_rendered_scene,
)

from .table1 import NOISE, agrees, joint_methods, methods, print_table, unseen_deviations

TIP = np.array([0.0, 0.0, 0.15])
"""Of the stylus, in the tool's frame, m."""

TOUCHES = 50


def predictors(scene: Scene) -> dict[str, Predictor]:
    """Every method of Table 1, and staged and joint with the centres of circles corrected."""
    fits = methods() | joint_methods()
    found = {name: fit(scene.data) for name, fit in fits.items()}
    for name in ("staged", "joint, noise given"):
        first = found[name]
        assert isinstance(first, sv.Calibration)
        corrected = sv.correct_circle_centres(scene.data, first)
        found[f"{name}, centres"] = fits[name](corrected)
    return found


def stylus_misses(
    calibration: sv.Calibration, truth: sv.Calibration, seed: int, noise: sv.Noise | None
) -> np.ndarray:
    """Distances from the tip to the world's origin, `(touches,)`, m: stylus upright, any turn."""
    rng = np.random.default_rng((seed, 4))
    turns = SO3.from_z_radians(np.asarray(rng.uniform(-np.pi, np.pi, TOUCHES)))
    upright = SO3.from_x_radians(np.full(TOUCHES, np.pi))
    sizes = (0.0, 0.0) if noise is None else (noise.translation, noise.rotation)
    deviations = np.repeat(sizes, 3)
    errors = deviations * rng.standard_normal((TOUCHES, 6))
    miss = stylus_error(calibration, truth, TIP, touching_pose(TIP, turns @ upright), errors)
    return np.linalg.norm(np.asarray(miss), axis=-1)


def run(smoke: bool = False) -> bool:
    """Print both tables; True where the paper's rows are within their spread of its own."""
    seeds = range(1 if smoke else 20)
    deviations: dict[str, list[np.ndarray]] = {}
    misses: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for seed in seeds:
        where = f"seed {seed + 1} of {len(seeds)}"
        scene = paper_rendered_scene(seed, progress=lambda text, at=where: _say(f"{at}, {text}"))
        unseen = paper_held_out(seed, RENDERED_PAPER_SETUP)
        _say(f"{where}, fits")
        for name, predictor in predictors(scene).items():
            deviations.setdefault(name, []).append(unseen_deviations(predictor, unseen))
            if isinstance(predictor, sv.Calibration):
                truth = scene.calibration
                pair = (
                    stylus_misses(predictor, truth, seed, None),
                    stylus_misses(predictor, truth, seed, NOISE),
                )
                misses.setdefault(name, []).append(pair)
    _say("")
    means = print_table(deviations)
    print(f"\n{'stylus test, RMS mm':32}{'exact robot':>14}{'its noise':>14}{'worst seed':>14}")
    for name, pairs in misses.items():
        still, noisy = (1e3 * np.array(runs) for runs in zip(*pairs, strict=True))
        print(f"{name:32}{_rms(still):14.3f}{_rms(noisy):14.3f}{still.max():14.3f}")
    return agrees(means)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _say(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{text:40}\r", end="", file=sys.stderr, flush=True)
