"""The kinematics of a real two-axis positioner from measured poses of the target on it.

The bounds are what two free twists and a home pose reach on the same 205 poses, 1 m counted as
1 rad, with the ratios of the gears free and held at one.
"""

import time

import smartview_jax as sv

from .real_sets import SHARED

MEASURED = SHARED / "rct_positioner_kinematic" / "positioner_kinematic_measurements.yaml"

BOUNDS = {True: (0.39, 0.05), False: (0.42, 0.055)}
"""mm and degrees, RMS, with the ratios free or held."""


def run(smoke: bool = False) -> bool:
    """Print the table; True where every figure is within its bound. `smoke` changes nothing."""
    del smoke
    if not MEASURED.is_file():
        print("skipped: the measured poses are not next to this checkout (shared/data)")
        return True
    joints, poses = sv.io.read_robot_cal_kinematics(MEASURED)
    print(f"{'ratios':8}{'mm':>8}{'bound':>8}{'degrees':>9}{'bound':>8}{'seconds':>9}")
    good = True
    for free, (mm, degrees) in BOUNDS.items():
        began = time.perf_counter()
        fit = sv.fit_kinematics(joints, poses, free_ratios=free)
        seconds = time.perf_counter() - began
        within = fit.rms_mm <= mm and fit.rms_degrees <= degrees
        good = good and within
        ratios = ", ".join(
            f"{ratio:.5f} +- {fit.std[f'joint_ratio.{1 + k}'][0]:.5f}"
            for k, ratio in enumerate(fit.ratios.tolist() if free else [])
        )
        print(
            f"{'free' if free else 'held':8}{fit.rms_mm:8.4f}{mm:8.3f}{fit.rms_degrees:9.4f}"
            f"{degrees:8.3f}{seconds:9.1f}  {ratios}{'' if within else '  OUT OF BOUND'}"
        )
    return good
