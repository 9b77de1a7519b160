import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from text_files import edit

from smartview_jax import Calibration
from smartview_jax.cameras import AbstractPerspectiveLens, Camera, Pinhole, lens_by_name
from smartview_jax.geometry import ViewedRegion
from smartview_jax.robot_errors import LinearInPosition, RobotError

LENSES = ("pinhole", "radial", "weng", "opencv4", "opencv5", "opencv8", "fisheye")


def pose(*tangent):
    return SE3.exp(jnp.asarray(tangent, dtype=float))


def camera(lens=None):
    return Camera(800.0, 790.0, 321.0, 239.0, Pinhole() if lens is None else lens, (640, 480))


def corrected(calibration):
    """The calibration, with a correction of the robot's error."""
    field = LinearInPosition(jnp.array([0.4, 0.0, 0.3]), jnp.asarray(0.2))
    error = RobotError(field, 1e-3 * jnp.arange(18.0))
    return dataclasses.replace(calibration, robot_error=error)


@pytest.fixture
def eye_in_hand():
    return Calibration.eye_in_hand(
        camera(), pose(0.01, 0.02, -0.05, 0.1, 0.2, -0.3), pose(0.5, 0.1, 0.0, 3.0, 0.1, 0.2), 1.01
    )


@pytest.fixture
def eye_to_hand():
    return Calibration.eye_to_hand(
        camera(), pose(0.1, 0.0, 1.5, 0.1, 3.0, 0.0), pose(0.0, 0.05, 0.1, 0.0, 0.2, 0.1)
    )


@pytest.fixture
def views_and_points(eye_in_hand):
    """Four views of the target, and one that has its back to it."""
    rng = np.random.default_rng(3)
    tangents = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]) + 0.1 * rng.normal(size=(5, 6))
    tangents[4, 2] = -0.5
    commands = eye_in_hand.command_for(SE3.exp(jnp.asarray(tangents)))
    return commands, rng.uniform(-0.1, 0.1, (7, 3))


def test_the_chain_is_equation_10(eye_in_hand, views_and_points):
    commands, points = views_and_points
    pixels, valid = eye_in_hand.project(commands, points)
    assert pixels.shape == (5, 7, 2)
    for view, base_from_tool in enumerate(np.asarray(commands.as_matrix())):
        chain = (
            np.asarray(eye_in_hand.camera_from_tool.as_matrix())
            @ np.linalg.inv(base_from_tool)
            @ np.asarray(eye_in_hand.base_from_world.as_matrix())
        )
        x, y, z = chain[:3, :3] @ (1.01 * points.T) + chain[:3, 3:]
        expected = np.stack([800.0 * x / z + 321.0, 790.0 * y / z + 239.0], axis=-1)
        in_front = z > 0.0
        np.testing.assert_array_equal(valid[view], in_front)
        np.testing.assert_allclose(pixels[view][in_front], expected[in_front], rtol=1e-10)
    assert valid[:4].all()
    assert not valid[4].any()


def test_the_chain_of_a_standing_camera(eye_to_hand, views_and_points):
    commands, _ = views_and_points
    expected = (
        eye_to_hand.camera_from_base.as_matrix()
        @ commands.as_matrix()
        @ eye_to_hand.tool_from_world.as_matrix()
    )
    np.testing.assert_allclose(
        eye_to_hand.camera_from_world(commands).as_matrix(), expected, atol=1e-12
    )


def test_points_may_differ_from_view_to_view(eye_in_hand, views_and_points):
    commands, points = views_and_points
    per_view = np.broadcast_to(points, (5, 7, 3))
    np.testing.assert_array_equal(
        eye_in_hand.project(commands, points)[0], eye_in_hand.project(commands, per_view)[0]
    )
    one = SE3(commands.wxyz_xyz[2])
    np.testing.assert_allclose(
        eye_in_hand.project(one, points)[0], eye_in_hand.project(commands, points)[0][2]
    )


def test_poses_may_be_matrices(eye_in_hand, views_and_points):
    commands, points = views_and_points
    np.testing.assert_allclose(
        eye_in_hand.project(np.asarray(commands.as_matrix()), points)[0],
        eye_in_hand.project(commands, points)[0],
        rtol=1e-9,
    )


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_the_command_for_a_view_gives_that_view(mount, views_and_points, request):
    calibration = request.getfixturevalue(mount)
    wanted, _ = views_and_points
    reached = calibration.camera_from_world(calibration.command_for(wanted))
    np.testing.assert_allclose(reached.as_matrix(), wanted.as_matrix(), atol=1e-12)


def test_a_transform_that_the_mount_does_not_have(eye_in_hand, eye_to_hand):
    with pytest.raises(AttributeError, match="eye_to_hand calibration has camera_from_base"):
        _ = eye_to_hand.camera_from_tool
    with pytest.raises(AttributeError, match="not tool_from_world"):
        _ = eye_in_hand.tool_from_world


def test_projection_is_differentiable_and_batchable(eye_in_hand, views_and_points):
    commands, points = views_and_points

    def total(calibration, commands):
        pixels, valid = calibration.project(commands, points)
        return jnp.sum(jnp.where(valid[..., None], pixels, 0.0))

    value_and_gradient = eqx.filter_jit(eqx.filter_value_and_grad(total))
    _, gradient = value_and_gradient(eye_in_hand, commands)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    step = 1e-6

    def shifted(s):
        moved = eqx.tree_at(lambda c: c.camera.u0, eye_in_hand, jnp.asarray(s))
        return value_and_gradient(moved, commands)[0]

    numeric = (shifted(321.0 + step) - shifted(321.0 - step)) / (2.0 * step)
    np.testing.assert_allclose(gradient.camera.u0, numeric, rtol=1e-6)
    batched, _ = jax.jit(jax.vmap(lambda c: eye_in_hand.project(c, points)))(commands)
    np.testing.assert_allclose(batched, eye_in_hand.project(commands, points)[0])


@pytest.mark.parametrize("name", LENSES)
def test_what_is_saved_is_loaded_to_the_last_digit(name, tmp_path, eye_in_hand, eye_to_hand):
    lens = lens_by_name(name)
    lens = type(lens)(**{key: 0.01 * (i + 1) / 3.0 for i, key in enumerate(vars(lens))})
    for calibration in (eye_in_hand, eye_to_hand):
        written = eqx.tree_at(lambda c: c.camera, calibration, camera(lens))
        written.save(tmp_path / "calibration.yaml")
        assert eqx.tree_equal(Calibration.load(tmp_path / "calibration.yaml"), written)


def test_what_could_not_be_read_back_is_not_written(tmp_path, eye_in_hand):
    far = SE3.from_translation(jnp.array([2e4, 0.0, 0.0]))
    lost = eqx.tree_at(lambda c: c.camera_from_mount, eye_in_hand, far)
    unknown = eqx.tree_at(lambda c: c.camera.alpha_u, eye_in_hand, jnp.asarray(jnp.nan))
    for wrong, entry in ((lost, "camera_from_tool.translation"), (unknown, "camera.alpha_u")):
        with pytest.raises(ValueError, match=rf"out\.yaml: not written, .*{entry}"):
            wrong.save(tmp_path / "out.yaml")
        assert not (tmp_path / "out.yaml").exists()


class Squeezed(AbstractPerspectiveLens):
    """A lens of a user's own."""

    squeeze: jax.Array

    def __init__(self, squeeze):
        self.squeeze = jnp.asarray(squeeze, dtype=float)

    def distort_normalised(self, ideal):
        return ideal * (1.0 - self.squeeze), jnp.ones(ideal.shape[:-1], dtype=bool)

    def undistort_normalised(self, distorted):
        return distorted / (1.0 - self.squeeze), jnp.ones(distorted.shape[:-1], dtype=bool)


def test_a_lens_of_ones_own_is_saved_and_loaded(tmp_path, eye_in_hand):
    written = eqx.tree_at(lambda c: c.camera, eye_in_hand, camera(Squeezed(0.2)))
    written.save(tmp_path / "own.yaml")
    with pytest.raises(ValueError, match=r"own\.yaml.*Squeezed"):
        Calibration.load(tmp_path / "own.yaml")
    assert eqx.tree_equal(Calibration.load(tmp_path / "own.yaml", lens=Squeezed(0.0)), written)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("smartview_calibration: 2", "smartview_calibration: 9", "is one of 1, 2; found 9"),
        ("mount: eye_in_hand", "mount: ceiling", "found 'ceiling'"),
        ("target_scale", "targetscale", "called 'targetscale'; did you mean 'target_scale'"),
        ("target_scale: 1.01\n", "", "entry 'target_scale' is missing"),
        ("target_scale: 1.01", "target_scale: 0", "target_scale: expected .* 0.001 .*found 0"),
        ("quaternion_wxyz: [", "quaternion_wxyz: [1.0, ", "camera_from_tool.quaternion_wxyz: exp"),
        ("translation: [", "translation: [1000.0, ", "camera_from_tool.translation: exp.* 3 numb"),
        ("alpha_u: 800.0", "alpha_w: 800.0", "camera: .*'alpha_w'; did you mean 'alpha_[uv]'"),
        ("alpha_u: 800.0", "alpha_u: .nan", "camera.alpha_u: expected .* px, from 1.* found nan"),
        ("alpha_u: 800.0", "alpha_u: -1", "camera.alpha_u: expected .* found -1"),
        ("alpha_u: 800.0", "alpha_u: 1\n  alpha_u: 2", "key 'alpha_u' comes twice"),
        ("length: m", "length: mm", "units.length: expected m, found 'mm'"),
        ("model: pinhole", "model: pinhol", "lens is one of .*'pinhol'; did you mean 'pinhole'"),
        ("model: pinhole", "model: radial", "camera.lens: .*k1"),
        ("model: pinhole", "model: pinhole, k1: 0.1", "camera.lens: .*k1"),
        ("model: position", "model: pos", "field is one of .*'pos'"),
        ("reach: 0.2", "reach: 0", "robot_error.field.reach: expected .*found 0"),
        ("centre: [0.4, 0.0, 0.3]", "centre: [0.4, 0.0]", "robot_error.field.centre: expected"),
        ("centre: [0.4, 0.0, 0.3]", "centre: {x: 1}", "robot_error.field.centre"),
        ("translation_by_position.3: ", "translation_by_positio.3: ", "translation_by_positio.3"),
        ("translation_by_position.3: 0.003", "translation_by_position.3: .inf", "found inf"),
    ],
)
def test_a_wrong_file_names_itself_and_the_entry(tmp_path, eye_in_hand, old, new, message):
    path = tmp_path / "calibration.yaml"
    corrected(eye_in_hand).save(path)
    edit(path, old, new)
    with pytest.raises(ValueError, match=rf"calibration\.yaml: .*{message}"):
        Calibration.load(path)


def test_a_file_that_was_cut_anywhere_is_refused(tmp_path, eye_in_hand):
    """Above all before `robot_error`, where what is left would load without the correction."""
    path = tmp_path / "calibration.yaml"
    corrected(eye_in_hand).save(path)
    whole = path.read_text()
    assert eqx.tree_equal(Calibration.load(path), corrected(eye_in_hand))
    for end in {*range(1, len(whole.rstrip()), 23), whole.index("robot_error")}:
        path.write_text(whole[:end])
        with pytest.raises(ValueError, match=r"calibration\.yaml: "):
            Calibration.load(path)


def test_files_of_version_1_load_where_nothing_can_be_missing(tmp_path, eye_in_hand):
    """They have no end mark, and name no robot_error where there is none."""
    path = tmp_path / "calibration.yaml"
    corrected(eye_in_hand).save(path)
    text = path.read_text().replace("smartview_calibration: 2", "smartview_calibration: 1")
    old = text.replace("end: smartview_calibration\n", "")
    assert old != text
    path.write_text(old)
    assert eqx.tree_equal(Calibration.load(path), corrected(eye_in_hand))
    cut = old[: old.index("robot_error")]
    path.write_text(cut)
    with pytest.raises(
        ValueError, match=r"may be truncated: if it is complete, add .*robot_error: null"
    ):
        Calibration.load(path)
    path.write_text(cut + "robot_error: null\n")
    assert Calibration.load(path).robot_error is None


CAMERAS = np.array([[0.0, 0.1, 0.5], [0.2, 0.1, 0.7], [0.1, 0.4, 0.6]])


def seen_from(calibration, tools=CAMERAS):
    """The calibration, as if it were fitted to views from these places."""
    region = ViewedRegion.from_positions(CAMERAS, np.zeros((1, 3)), tools)
    return dataclasses.replace(calibration, region=region)


@pytest.mark.parametrize("tools", [None, CAMERAS])
def test_where_the_target_was_seen_from_is_saved_and_loaded(tmp_path, eye_in_hand, tools):
    written = seen_from(eye_in_hand, tools)
    path = tmp_path / "calibration.yaml"
    written.save(path)
    assert eqx.tree_equal(Calibration.load(path), written)
    path.write_text(path.read_text().replace("lowest_tool: 0.5", "lowest_tool: null"))
    region = Calibration.load(path).region
    assert region is not None
    assert np.isinf(region.min_tool_height)


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("side", "up"),
        ("middle", [1.0, 2.0]),
        ("reach", float("nan")),
        ("reach", -1.0),
        ("distance", [2.0, 1.0]),
        ("distance", [0.0, 1.0]),
        ("plane", "low"),
        ("lowest_tool", "low"),
        ("lowest_tool", 1e6),
        ("highest_tool", 1.0),
    ],
)
def test_what_is_wrong_with_the_region_is_named(eye_in_hand, entry, value):
    content = seen_from(eye_in_hand).to_dict()
    content["region"][entry] = value
    with pytest.raises(ValueError, match=rf"region.*{entry}"):
        Calibration.from_dict(content)
