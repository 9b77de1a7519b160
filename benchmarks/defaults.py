"""Which lens and which noise should `calibrate` take by itself: held-out error on the real sets.

Every choice is refitted in every fold and judged on the views it never saw: lenses where the sizes
of all errors are found by likelihood, then, with the lens of the default, a robot that is trusted,
and poses whose white noise is given the size that a good industrial arm has.
"""

import jax
import numpy as np

import smartview_jax as sv

from .real_sets import SETS, held_out_px, load, present

LENSES = ("pinhole", "radial", "opencv4", "opencv5")
NOISES = {
    "estimated": "estimated",
    "trusted": "trusted",
    "0.1 mm, 0.01 deg": sv.Noise(pixel=0.15, translation=1e-4, rotation=float(np.deg2rad(0.01))),
    "1 mm, 0.1 deg": sv.Noise(pixel=0.15, translation=1e-3, rotation=float(np.deg2rad(0.1))),
}
CHOICES = [(lens, "estimated") for lens in LENSES] + [("opencv4", n) for n in list(NOISES)[1:]]


def run(smoke: bool = False) -> bool:
    """Print RMS held-out error, px, of every choice on every set; lower is better."""
    sets = present(SETS[: 1 if smoke else None])
    choices = CHOICES[2:3] if smoke else CHOICES
    if not sets:
        return True
    print(f"{'set':26}" + "".join(f"{lens + ', ' + noise:>26}" for lens, noise in choices))
    shares = []
    for folder, prefix in sets:
        data, _ = load(folder, prefix)
        errors = [_held_out(data, lens, noise) for lens, noise in choices]
        shares.append(np.array(errors) / np.nanmin(errors))
        print(f"{folder + ' ' + prefix.rstrip('_'):26}" + "".join(f"{e:26.4g}" for e in errors))
    middle = np.exp(np.nanmean(np.log(shares), axis=0))
    print(f"{'times the best, mean':26}" + "".join(f"{share:26.3f}" for share in middle))
    return bool(np.isfinite(shares).all())


def _held_out(data: sv.Dataset, lens: str, noise: str) -> float:
    # Every choice compiles its own programs; all of them together exhaust a process's memory maps.
    jax.clear_caches()
    return held_out_px(data, lambda part: sv.calibrate(part, lens, noise=NOISES[noise]).joint)
