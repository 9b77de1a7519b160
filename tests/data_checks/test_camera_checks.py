"""A camera that does not fit the views is told from a robot that does not move as it says."""

import dataclasses

import numpy as np
import pytest
from jaxlie import SE3
from shared_data import shared_case

from smartview_jax import Dataset
from smartview_jax.cameras import Fisheye
from smartview_jax.data_checks import camera_checks
from smartview_jax.data_checks.camera_checks import ViewsAlone, camera_misfit, camera_problem
from smartview_jax.staged import fit_staged

USED = np.ones(8, dtype=bool)


@pytest.fixture(scope="module")
def seen(scene):
    """The scene's observations, true camera and poses."""
    poses = SE3(scene.calibration.camera_from_world(scene.base_from_tool).wxyz_xyz)
    return scene.data.observations, scene.calibration.camera, poses


def test_the_true_camera_is_not_doubted(seen):
    observations, camera, poses = seen
    assert camera_misfit(ViewsAlone(observations), USED, camera, poses) is None


def test_a_known_camera_of_other_pictures_is_doubted(seen):
    """Pictures of half the size, scaled up: as if the focal length were another one."""
    observations, camera, poses = seen
    wrong = dataclasses.replace(camera, alpha_u=1.2 * camera.alpha_u)
    misfit = camera_misfit(ViewsAlone(observations), USED, wrong, poses)
    assert misfit is not None
    text = camera_problem(misfit, "radial", True, lambda _: (wrong, poses), observations, USED)
    assert text.startswith("the known camera does not fit these pictures: with a free pose")


def test_each_view_is_fitted_alone_once(seen, monkeypatch):
    """However many cameras and masks are asked: the fits depend on neither."""
    observations, camera, poses = seen
    wrong = dataclasses.replace(camera, alpha_u=1.2 * camera.alpha_u)
    fitted, fit = [], camera_checks.fit_of_any_lens
    monkeypatch.setattr(
        camera_checks, "fit_of_any_lens", lambda *given: fitted.append(given) or fit(*given)
    )
    alone = ViewsAlone(observations)
    few = camera_misfit(alone, np.arange(8) < 3, camera=wrong, camera_from_world=poses)
    assert len(fitted) == 3
    first, second = (camera_misfit(alone, USED, wrong, poses) for _ in range(2))
    assert len(fitted) == len(USED)
    assert first == second != few


def test_a_fisheye_is_not_blamed_on_the_robot():
    """Points to 100 degrees off the axis, and a robot that is right."""
    case = np.load(shared_case("fisheye200.npz"))
    size = tuple(case["image_size"].tolist())
    data = Dataset.from_arrays(
        case["points"], case["pixels"][::2], case["base_from_tool"][::2], size
    )
    first, second = fit_staged(data, "opencv4", conventions="report").conventions.problems
    assert first.startswith("the lens opencv4 does not fit these pictures: with a free pose")
    assert first.endswith("use lens='fisheye' (--lens fisheye)")
    assert second.startswith("as seen with this camera, robot and camera do not move alike")


def test_a_lens_that_fits_is_named_and_otherwise_none(seen):
    observations, camera, poses = seen
    wrong = dataclasses.replace(camera, lens=Fisheye(k1=-0.9))
    misfit = camera_misfit(ViewsAlone(observations), USED, wrong, poses)
    assert misfit is not None

    def fitted(name):
        return (camera if name == "opencv8" else wrong), poses

    text = camera_problem(misfit, wrong.lens, False, fitted, observations, USED)
    assert "the lens fisheye does not fit these pictures: with a free pose in every view" in text
    assert text.endswith("use lens='opencv8' (--lens opencv8)")
    text = camera_problem(misfit, "fisheye", False, lambda _: (wrong, poses), observations, USED)
    assert text.startswith("no single camera fits these pictures: with the lens fisheye")
    assert "Did zoom or focus change" in text
