"""A folder of pictures of an object by several cameras, and the calibration that reads it."""

import cv2
import numpy as np
import pytest
import yaml
from rig_pair import BASE_FROM_WORLD, placed, stereo_pair

import smartview_jax as sv
from smartview_jax.cli.load import RigOptions, load_calibrated_views, load_views
from smartview_jax.geometry import host_matrices
from smartview_jax.io import is_rig_object_views, load_rig_object_views, write_object_views
from smartview_jax.joint import RIG_FILE

STATES = ["1", "2"]
POSES = np.stack([BASE_FROM_WORLD @ placed(x) for x in (0.0, 0.1)])


@pytest.fixture
def folder(tmp_path):
    """Both cameras in the first state of the robot, the right one alone in the second."""
    rng = np.random.default_rng(0)
    left = rng.integers(0, 255, (12, 16), np.uint8)
    write_object_views(tmp_path, STATES, [left, left], POSES)
    described = yaml.safe_load((tmp_path / "object_views.yaml").read_text())
    del described["camera"]
    described["cameras"] = {"left": {"image_size": [16, 12]}, "right": {"image_size": [20, 10]}}
    described["pictures"] = {"pattern": "images/{camera}/{view}.png"}
    (tmp_path / "object_views.yaml").write_text(yaml.safe_dump(described))
    for camera, shape, states in (("left", (12, 16), "1"), ("right", (10, 20), "12")):
        (tmp_path / "images" / camera).mkdir()
        for state in states:
            picture = rng.integers(0, 255, shape, np.uint8)
            cv2.imwrite(str(tmp_path / "images" / camera / f"{state}.png"), picture)
    return tmp_path


@pytest.fixture
def calibrated(tmp_path):
    """As `RigFit.save` writes a rig that it cannot tell the uncertainty of."""
    place = tmp_path / "calibration"
    cameras = stereo_pair()
    for name, calibration in cameras.items():
        calibration.save(place / f"{name}.yaml")
    names = {name: list(sv.engine.parameter_names(c)) for name, c in cameras.items()}
    content = {
        "smartview_rig": 1,
        "cameras": {name: f"{name}.yaml" for name in cameras},
        "parameters_of": names,
        "end": "smartview_rig",
    }
    (place / RIG_FILE).write_text(yaml.safe_dump(content))
    return place


def test_each_picture_has_its_camera_and_the_pose_of_its_state(folder):
    assert is_rig_object_views(folder)
    views = load_rig_object_views(folder)
    assert views.view_ids == ("left/1", "right/1", "right/2")
    assert views.cameras == ("left", "right", "right")
    assert views.states == ("1", "1", "2")
    assert [picture.shape for picture in views.pictures] == [(12, 16), (10, 20), (10, 20)]
    actual = host_matrices(views.command.base_from_tool)
    np.testing.assert_allclose(actual, POSES[[0, 0, 1]], atol=1e-15)


def test_cameras_next_to_the_arm_need_no_robot(folder):
    path = folder / "object_views.yaml"
    described = yaml.safe_load(path.read_text())
    del described["poses"]
    path.write_text(yaml.safe_dump(described))
    with pytest.raises(ValueError, match="expected an entry 'poses', 'joints', or both; or 'views"):
        load_rig_object_views(folder)
    path.write_text(yaml.safe_dump({**described, "views": STATES}))
    assert load_rig_object_views(folder).command is None
    path.write_text(yaml.safe_dump({**described, "views": [*STATES, "3"]}))
    with pytest.raises(FileNotFoundError, match="no camera has a picture of view 3"):
        load_rig_object_views(folder)


def test_a_rigs_calibration_reads_pictures_of_its_cameras(folder, calibrated):
    views = load_views(folder)
    fit, estimate, is_exact = load_calibrated_views(calibrated, views, RigOptions(frame="base"))
    assert fit.cameras == ("left", "right", "right")
    assert fit.states == ("1", "1", "2")
    assert fit.frame == "base"
    assert estimate is None
    assert is_exact
    one = views._replace(cameras=(), states=())
    fit, _, _ = load_calibrated_views(calibrated / RIG_FILE, one, RigOptions("right"))
    assert fit.cameras == ("right",) * 3
    alone, _, _ = load_calibrated_views(calibrated / "left.yaml", one, RigOptions())
    assert isinstance(alone, sv.Calibration)


def test_a_calibration_that_does_not_belong_to_the_pictures_is_named(folder, calibrated):
    views = load_views(folder)
    one = views._replace(cameras=(), states=())
    for path, given, camera, frame, said in (
        ("left.yaml", views, None, "world", "the views are of cameras left, right: give"),
        ("left.yaml", one, "left", "world", "--camera and --frame are for .* a rig"),
        (".", one, None, "world", "a rig of left, right, and pictures of one camera: name it"),
        (".", views, "left", "world", "--camera left: the folder names the cameras"),
        (".", one, "middle", "world", "expected a camera of left, right, found 'middle'"),
    ):
        with pytest.raises(ValueError, match=said):
            load_calibrated_views(calibrated / path, given, RigOptions(camera, frame))
