"""JAX computes in double precision, however it is imported; where it does not, every entry says so.

Each case is a process of its own: what JAX counts in is decided while it is imported.
"""

import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.io import sample_folder
from smartview_jax.runtime.double_precision import VARIABLE
from smartview_jax.simulation import random_scene
from smartview_jax.staged import kalman_filter

MADE_64_BIT = "assert jnp.zeros(1).dtype == 'float64'"


def run(code, **settings):
    # A user's process, without this one's settings of JAX.
    environment = {name: value for name, value in os.environ.items() if "JAX" not in name}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment | settings
    )


@pytest.mark.parametrize(
    ("first", "settings"),
    [
        ("import jax.numpy as jnp, smartview_jax", {}),
        ("from smartview_jax.cameras import Camera; import jax.numpy as jnp", {}),
        # Looking for JAX is not importing it; libraries do so to see whether it is installed.
        (
            "import smartview_jax, importlib.util; importlib.util.find_spec('jax')\n"
            "import jax.numpy as jnp",
            {},
        ),
        ("import smartview_jax, equinox, jax.numpy as jnp", {VARIABLE: "0"}),
        ("import jax.numpy as jnp, smartview_jax", {VARIABLE: "0"}),
    ],
)
def test_every_array_of_the_user_has_64_bits(first, settings):
    done = run(f"{first}\n{MADE_64_BIT}", **settings)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    scene = random_scene(0, views=8)
    path = tmp_path_factory.mktemp("saved") / "calibration.yaml"
    scene.calibration.save(path)
    return SimpleNamespace(
        data=scene.data,
        calibration=scene.calibration,
        poses=scene.calibration.camera_from_world(scene.base_from_tool),
        points=np.asarray(scene.data.points),
        pixels=np.asarray(scene.data.pixels),
        matrices=np.asarray(scene.base_from_tool.as_matrix()),
        path=path,
    )


ENTRIES = {
    "calibrate": lambda case: sv.calibrate(case.data),
    "fit_staged": lambda case: sv.fit_staged(case.data),
    "fit_joint": lambda case: sv.fit_joint(case.data, case.calibration, noise="trusted"),
    "fit_camera": lambda case: sv.fit_camera(case.data, case.calibration.camera, case.poses),
    "build_problem": lambda case: sv.build_problem(case.data, case.calibration),
    "Step 2": lambda case: kalman_filter(
        case.data.observations, case.calibration.camera, case.poses
    ),
    "Dataset.from_arrays": lambda case: sv.Dataset.from_arrays(
        case.points, case.pixels, case.matrices, case.data.image_size
    ),
    "load_dataset": lambda _: sv.load_dataset(sample_folder()),
    "Calibration.load": lambda case: sv.Calibration.load(case.path),
}


@pytest.mark.parametrize("name", ENTRIES)
def test_every_entry_refuses_single_precision(name, case, monkeypatch):
    """At once: a second thread has settings of its own, and would go on."""
    rehearsed = []
    monkeypatch.setattr(
        "smartview_jax.calibration_pipeline.precompile", lambda *_, **__: rehearsed.append(name)
    )
    with (
        jax.enable_x64(False),
        pytest.raises(RuntimeError, match=r"single precision.*jax_enable_x64"),
    ):
        ENTRIES[name](case)
    assert not rehearsed
