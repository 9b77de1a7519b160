"""Known objects in spoilt pictures: found in moderate ones, and never a wrong pose in bad ones."""

from collections.abc import Callable

import cv2
import numpy as np

from smartview_jax.localization import localize

from .hypotheses import pose_errors
from .localization_scenes import CELL_ROWS, ROWS, LocalizationScene, localization_scene
from .localization_trials import is_right

SCENES = (("stepped", 30_000), ("box", 30_001), ("roofed", 30_002))
"""Objects, and the seeds of their scenes."""

Spoilt = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def _blurred(sigma: float) -> Spoilt:
    """Return what blurs a picture by a standard deviation, px."""
    return lambda picture, _: cv2.GaussianBlur(picture, (0, 0), sigma)


def _noisy(sigma: float) -> Spoilt:
    """Return what adds noise of a standard deviation, grey levels."""
    return lambda picture, rng: _grey(picture + rng.normal(0.0, sigma, picture.shape))


def _exposed(factor: float) -> Spoilt:
    """Return what multiplies the brightness by a factor."""
    return lambda picture, _: _grey(factor * picture.astype(float))


def _grey(levels: np.ndarray) -> np.ndarray:
    """Return grey levels as a picture has them."""
    return np.clip(levels, 0.0, 255.0).astype(np.uint8)


MODERATE = {
    "blurred by 1.2 px": _blurred(1.2), "noise of 3": _noisy(3.0), "0.6 as bright": _exposed(0.6),
}  # fmt: skip
BAD = {
    "blurred by 4 px": _blurred(4.0), "blurred by 9 px": _blurred(9.0), "noise of 40": _noisy(40.0),
    "0.15 as bright": _exposed(0.15), "1.8 as bright": _exposed(1.8),
}  # fmt: skip

SMOKE_KINDS = "noise of 3", "0.15 as bright"
"""Kinds of a smoke run, one of each sort."""


def print_spoilt_pictures(smoke: bool = False) -> bool:
    """Print what is found in spoilt pictures; True where all is right and the moderate suffice."""
    rows = CELL_ROWS if smoke else ROWS
    scenes = [
        localization_scene(name, "single", seed, rows=rows)
        for name, seed in SCENES[: 1 if smoke else 3]
    ]
    # Blurred pictures are reduced, and programs are compiled for each size.
    spoilt_by = MODERATE | BAD
    kinds = [(name, spoilt_by[name]) for name in (SMOKE_KINDS if smoke else spoilt_by)]
    print(f"\n{'spoilt pictures':20}{'scenes':>8}{'right':>8}{'wrong':>8}")
    good = True
    for name, spoilt in kinds:
        counts = np.sum([_right_and_wrong(scene, spoilt) for scene in scenes], axis=0)
        print(f"{name:20}{len(scenes):8}{counts[0]:8}{counts[1]:8}")
        good &= counts[1] == 0 and (name in BAD or counts[0] == len(scenes))
    return bool(good)


def _right_and_wrong(scene: LocalizationScene, spoilt: Spoilt) -> tuple[int, int]:
    """Return the numbers of right and of wrong poses that are accepted in spoilt pictures."""
    rng = np.random.default_rng(0)
    pictures = [spoilt(picture, rng) for picture in scene.pictures]
    try:
        localizations = localize(
            pictures, scene.base_from_tool, scene.calibration, scene.model
        ).accepted
    except ValueError:
        # A picture on which nothing can be seen is refused.
        return 0, 0
    poses = [obj.world_from_object[None] for obj in localizations]
    errors = [pose_errors(scene.model, pose, scene.world_from_object) for pose in poses]
    right = sum(is_right(float(angle[0]), float(shift[0])) for angle, shift in errors)
    return right, len(localizations) - right
