"""A fit on all devices of one or several processes, as a program of its own; prints JSON.

JAX reads how many devices there are when it starts, so the tests cannot do this themselves.
"""

import json
import sys

import jax

address, count, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
if count > 1:
    jax.distributed.initialize(address, num_processes=count, process_id=number)

import numpy as np  # noqa: E402
from starts import nudged  # noqa: E402

import smartview_jax as sv  # noqa: E402
from smartview_jax.engine.problem_builder import build_problem  # noqa: E402
from smartview_jax.engine.sharding import shard  # noqa: E402
from smartview_jax.simulation import paper_points, random_scene  # noqa: E402

# Seven views do not go evenly into two.
scene = random_scene(2, 7, paper_points((0.0, 0.02))[::5], translation_noise=1e-4)
start = nudged(scene.calibration)
answers = []
for noise in ("trusted", sv.Noise(0.15, 1e-4, 1e-4)):
    for devices in (None, jax.devices()):
        fit = sv.fit_joint(scene.data, start, noise=noise, devices=devices)
        answers.append(
            {
                "found": [
                    float(fit.calibration.camera.alpha_u),
                    *np.asarray(fit.calibration.camera_from_tool.translation()).tolist(),
                ],
                "std": [
                    fit.std[name]
                    for name in fit.parameter_names
                    if name == "camera.alpha_u" or name.startswith("camera_from_tool.translation")
                ],
                "corrections": np.asarray(fit.pose_corrections).tolist(),
                "cost": fit.solution.costs[-1],
                "converged": fit.result.converged,
            }
        )
problem = build_problem(scene.data, start, noise=sv.Noise(0.15, 1e-4, 1e-4)).problem
dealt = shard(problem, jax.devices()).observations.visible.addressable_shards
many = None
if count == 1:
    # Three fits do not go evenly into two devices.
    sets = [random_scene(k, 6, paper_points((0.0, 0.02))[::6]).data for k in range(3)]
    many = [
        np.asarray(sv.fit_many(sets, start, devices=devices).calibrations.camera.alpha_u).tolist()
        for devices in (None, jax.devices())
    ]
answer = {
    "devices": jax.device_count(),
    "views_here": [len(shard.data) for shard in dealt],
    "fits": answers,
    "many": many,
}
sys.stdout.write(f"{json.dumps(answer)}\n")
