"""Views dealt out to the devices of two processes, against one device."""

import json
import math
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from arms_scene import NOISE as ARMS_NOISE
from arms_scene import arms_scene
from fits_to_compare import NOISE, described, described_rig, one_fit, rig_fit, sets, start
from jax.sharding import PartitionSpec

from smartview_jax import fit_joint
from smartview_jax.engine import build_arms, build_rig
from smartview_jax.engine.rig_sharding import shard_rig

HERE = Path(__file__).parent


def run(processes, devices_each):
    """What every process of a fit printed."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    environment = {
        **os.environ,
        # After the flags by which the tests compile, so that programs are shared with them.
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} "
        f"--xla_force_host_platform_device_count={devices_each}",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")]),
    }
    started = [
        subprocess.Popen(
            [
                sys.executable,
                str(HERE / "fit_on_devices.py"),
                address,
                str(processes),
                str(k),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for k in range(processes)
    ]
    try:
        printed = [process.communicate(timeout=600) for process in started]
    finally:
        for process in started:
            process.kill()
    for process, (_, errors) in zip(started, printed, strict=True):
        assert process.returncode == 0, errors[-3000:]
    return [json.loads(out.splitlines()[-1]) for out, _ in printed]


def test_two_processes_find_what_one_device_finds():
    """Each of two devices."""
    alone, rig = described(one_fit(None)), described_rig(rig_fit(None))
    assert alone["converged"]
    answers = run(processes=2, devices_each=2)
    for answer in answers:
        assert answer["devices"] == 4
        # Seven views and one that shows nothing, among all devices or within one process.
        assert answer["views_here"] == [2, 2]
        assert answer["uncorrected_views_here"] == [4, 4]
        together = answer["fit"]
        assert together["converged"]
        assert together["cost"] == pytest.approx(alone["cost"], rel=1e-11)
        # Sums in another order end elsewhere by what is nothing next to the noise.
        gap = np.abs(np.array(together["found"]) - alone["found"]) / alone["std"]
        assert gap.max() < 1e-3
        np.testing.assert_allclose(together["corrections"], alone["corrections"], atol=1e-7)
        np.testing.assert_allclose(together["std"], alone["std"], rtol=1e-5)
        of_rig = answer["rig"]
        assert of_rig["converged"]
        assert of_rig["cost"] == pytest.approx(rig["cost"], rel=1e-11)
        np.testing.assert_allclose(of_rig["found"], rig["found"], atol=1e-9)
        np.testing.assert_allclose(of_rig["corrections"], rig["corrections"], atol=1e-7)
        np.testing.assert_allclose(of_rig["std"], rig["std"], rtol=1e-5)
    # Devices exchange sums over the views, and nothing of single views.
    assert answers[0]["exchanges"] == ["all-reduce"]
    for found, data in zip(answers[0]["many"], sets(), strict=True):
        one = fit_joint(data, start(), noise=NOISE)
        # Another solver's last step: nothing next to the noise.
        assert abs(found - float(one.calibration.camera.alpha_u)) < 1e-3 * one.std["camera.alpha_u"]


def test_only_arrays_without_views_are_whole_on_each_device(monkeypatch):
    """The views of a rig need not fit on one device."""
    rig, truths = arms_scene(0, views=7)
    arms = {}
    for arm in rig.arm_names:
        part = rig.of_arm(arm)
        built = build_rig(part, {name: truths[name] for name in part.cameras}, noise=ARMS_NOISE)
        arms[arm] = built, built.problem.zero_step()
    problem = build_arms(rig, arms)[0].problem
    whole, put = [], jax.make_array_from_callback

    def recorded(shape, sharding, part):
        """Put an array on the devices, and keep its size if none is split."""
        if sharding.spec == PartitionSpec():
            whole.append(math.prod(shape))
        return put(shape, sharding, part)

    monkeypatch.setattr(jax, "make_array_from_callback", recorded)
    shard_rig(problem, jax.devices()[:1])
    pixels = problem.arms[0].problem.groups[0].problems.observations.pixels
    assert 0 < max(whole) < pixels.size
