import numpy as np
import pytest
import yaml

from smartview_jax.hand_eye import solve_hand_eye
from smartview_jax.io import PoseSamples, read_easy_handeye, write_easy_handeye
from smartview_jax.simulation import random_scene

# As `message_to_yaml` of ROS 2 writes a list of two.
TWO = """\
samples:
- robot:
    translation:
      x: 0.4
      y: -0.1
      z: 0.5
    rotation:
      x: 0.0
      y: 0.7071067811865476
      z: 0.0
      w: 0.7071067811865476
  tracking:
    translation: {x: 0.0, y: 0.0, z: 0.3}
    rotation: {x: 1.0, y: 0.0, z: 0.0, w: 0.0}
- robot:
    translation: {x: 0.5, y: -0.1, z: 0.5}
    rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}
  tracking:
    translation: {x: 0.1, y: 0.0, z: 0.3}
    rotation: {x: 0.0, y: 0.0, z: 0.0, w: 1.0}
"""


def test_a_file_is_read_as_ros_writes_it(tmp_path):
    (tmp_path / "arm.samples").write_text(TWO)
    samples = read_easy_handeye(tmp_path / "arm.samples")
    quarter_about_y = [[0, 0, 1, 0.4], [0, 1, 0, -0.1], [-1, 0, 0, 0.5], [0, 0, 0, 1]]
    np.testing.assert_allclose(samples.base_from_tool.as_matrix()[0], quarter_about_y, atol=1e-15)
    half_about_x = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(samples.camera_from_world.as_matrix()[0], half_about_x, atol=1e-15)
    inverted = read_easy_handeye(tmp_path / "arm.samples", "eye_to_hand")
    np.testing.assert_allclose(
        inverted.base_from_tool.as_matrix(), np.linalg.inv(samples.base_from_tool.as_matrix())
    )


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_samples_lead_to_the_hand_eye_transform(tmp_path, mount):
    scene = random_scene(2, views=8)
    truth = scene.calibration
    robot = scene.base_from_tool if mount == "eye_in_hand" else scene.base_from_tool.inverse()
    seen = truth.camera_from_world(scene.base_from_tool)
    write_easy_handeye(tmp_path / "arm.samples", PoseSamples(robot, seen, mount))
    samples = read_easy_handeye(tmp_path / "arm.samples", mount)
    np.testing.assert_allclose(samples.base_from_tool.as_matrix(), robot.as_matrix(), atol=1e-14)
    answer = solve_hand_eye(samples.mount_from_holder, samples.camera_from_world)
    np.testing.assert_allclose(
        answer.camera_from_mount.as_matrix(), truth.camera_from_mount.as_matrix(), atol=1e-6
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c.update(samples=[]),
            r"samples: expected a list of one .*, found \[\]",
        ),
        (lambda c: c["samples"][1].pop("tracking"), "entry .samples.1.tracking. is missing"),
        (
            lambda c: c["samples"][0]["robot"]["rotation"].update(w="x"),
            r"samples\.0\.robot\.rotation\.w: expected .* found 'x'",
        ),
        (
            lambda c: c["samples"][1]["robot"]["rotation"].update(w=3.0),
            r"samples\.1\.robot\.rotation\.w: .* found 3\.0",
        ),
        (lambda c: c["samples"][1]["robot"]["rotation"].update(w=0.5), "robot: .*row 1"),
        (
            lambda c: c["samples"][1]["robot"]["translation"].update(x=float("nan")),
            r"samples\.1\.robot\.translation\.x: expected m, .* found nan",
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path, change, message):
    content = yaml.safe_load(TWO)
    change(content)
    (tmp_path / "arm.samples").write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=rf"arm\.samples: {message}"):
        read_easy_handeye(tmp_path / "arm.samples")
