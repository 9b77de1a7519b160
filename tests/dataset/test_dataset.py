import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax import Dataset
from smartview_jax.dataset import chain_residuals
from smartview_jax.io import load_dataset, sample_folder
from smartview_jax.robots import kuka_lwr4
from smartview_jax.simulation import random_scene

VIEWS, POINTS = 4, 6


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    return {
        "points": rng.uniform(-0.1, 0.1, (POINTS, 3)),
        "pixels": rng.uniform(0.0, 480.0, (VIEWS, POINTS, 2)),
        "base_from_tool": np.array(SE3.exp(jnp.asarray(rng.normal(size=(VIEWS, 6)))).as_matrix()),
        "image_size": (640, 480),
    }


def test_shared_points_are_repeated_for_every_view(arrays):
    data = Dataset.from_arrays(**arrays)
    assert data.points.shape == (VIEWS, POINTS, 3)
    np.testing.assert_array_equal(data.points[2], arrays["points"])
    assert data.view_ids == ("0", "1", "2", "3")
    assert data.observation_count == VIEWS * POINTS


def test_poses_may_be_transforms_or_matrices(arrays):
    matrices = Dataset.from_arrays(**arrays)
    arrays["base_from_tool"] = SE3.from_matrix(jnp.asarray(arrays["base_from_tool"]))
    transforms = Dataset.from_arrays(**arrays)
    np.testing.assert_allclose(
        matrices.base_from_tool.as_matrix(), transforms.base_from_tool.as_matrix(), atol=1e-14
    )


def test_data_are_read_without_compiling_a_program(arrays):
    """NumPy does what is done once; a program takes a hundred times as long to build as to run."""
    poses = SE3.from_matrix(jnp.asarray(arrays["base_from_tool"]))
    with jax.no_execution():
        data = Dataset.from_arrays(**arrays)
        Dataset.from_arrays(**{**arrays, "base_from_tool": poses})
        data.mask_views([1]).select([0, 2])
        load_dataset(sample_folder(), keep_detections=False)
        # The check can fail: this is one.
        with pytest.raises(RuntimeError, match="tried to execute"):
            jnp.zeros(3) + 1.0


def test_the_callers_arrays_are_copied(arrays):
    """What is put on a device may share the memory of the array that it came from."""
    visible = np.ones((VIEWS, POINTS), dtype=bool)
    arrays["points"] = np.tile(arrays["points"], (VIEWS, 1, 1))
    data = Dataset.from_arrays(**arrays, visible=visible)
    before = [np.array(x) for x in (data.points, data.pixels, data.visible)]
    arrays["points"][:] = 0.0
    arrays["pixels"][:] = 0.0
    visible[:] = False
    for kept, now in zip(before, (data.points, data.pixels, data.visible), strict=True):
        np.testing.assert_array_equal(kept, now)


def test_pixels_that_are_nan_are_not_visible(arrays):
    arrays["pixels"][1, 2] = np.nan
    data = Dataset.from_arrays(**arrays)
    assert not data.visible[1, 2]
    assert data.observation_count == VIEWS * POINTS - 1


def test_a_hidden_pixel_is_poisoned_and_never_read(arrays):
    visible = np.ones((VIEWS, POINTS), dtype=bool)
    visible[0, 0] = False
    data = Dataset.from_arrays(**arrays, visible=visible)
    assert np.isnan(data.pixels[0, 0]).all()
    predicted = jnp.zeros((VIEWS, POINTS, 2))
    residuals = data.observations.residuals(predicted, jnp.ones((VIEWS, POINTS), dtype=bool))
    assert np.isfinite(residuals).all()
    np.testing.assert_array_equal(residuals[0, 0], [0.0, 0.0])
    np.testing.assert_array_equal(residuals[1, 1], arrays["pixels"][1, 1])


def test_select_takes_views_by_index_and_keeps_their_names(arrays):
    arrays["pixels"][3] = np.nan
    data = Dataset.from_arrays(
        **arrays, view_ids="abcd", masked_views=[("d", "no target found")]
    ).select([3, 1])
    assert data.view_ids == ("d", "b")
    assert data.masked_views == (("d", "no target found"),)
    np.testing.assert_array_equal(data.pixels[1], arrays["pixels"][1])
    assert data.select([1]).masked_views == ()
    np.testing.assert_array_equal(data.usable_views(), [1])


def test_select_takes_a_mask_and_no_view_twice(arrays):
    data = Dataset.from_arrays(**arrays, view_ids="abcd")
    mask = np.array([True, False, False, True])
    assert data.select(mask).view_ids == ("a", "d")
    assert data.select([]).view_ids == ()
    with pytest.raises(ValueError, match=r"views: expected each index once, found \[1, 1\]"):
        data.select([1, 1])


def test_what_cannot_be_predicted_has_an_infinite_residual():
    scene = random_scene(0, 4, pixel_noise=0.0)
    poses = scene.data.base_from_tool.wxyz_xyz
    turned = SE3(poses[2]) @ SE3.exp(jnp.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0]))
    data = eqx.tree_at(
        lambda d: d.base_from_tool.wxyz_xyz, scene.data, poses.at[2].set(turned.wxyz_xyz)
    )
    residuals = np.asarray(chain_residuals(scene.calibration, data.observations))
    assert np.isinf(residuals[2][np.asarray(data.visible[2])]).all()
    np.testing.assert_allclose(residuals[[0, 1, 3]], 0.0, atol=1e-9)


def test_a_view_known_to_be_unusable_may_have_no_pose(arrays):
    _nan(arrays["base_from_tool"])
    data = Dataset.from_arrays(**arrays, masked_views=[("2", "the arm did not answer")])
    assert data.masked_views == (("2", "the arm did not answer"),)
    assert np.isfinite(data.base_from_tool.wxyz_xyz).all()
    arrays["pixels"][0, 4] = [900.0, 20.0]
    with pytest.raises(ValueError, match="view 0: point 4"):
        Dataset.from_arrays(**arrays, masked_views=[("2", "the arm did not answer")])


@pytest.mark.parametrize(
    ("argument", "shape", "message"),
    [
        ("points", (5, 3), r"points: expected shape \(6, 3\) or \(4, 6, 3\)"),
        ("pixels", (4, 6), r"pixels: expected shape \(views, points, 2\)"),
        ("base_from_tool", (3, 4, 4), r"base_from_tool: expected shape \(4, 4, 4\)"),
    ],
)
def test_wrong_shapes_name_the_argument(arrays, argument, shape, message):
    arrays[argument] = np.ones(shape)
    with pytest.raises(ValueError, match=message):
        Dataset.from_arrays(**arrays)


def _mirror(poses):
    poses[2, :3, 0] *= -1.0


def _nan(poses):
    poses[2, 0, 3] = np.nan


def _shear(poses):
    poses[2, 0, :3] *= 1.1


def _row(poses):
    poses[2, 3, 3] = 2.0


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_mirror, "mirrored"),
        (_nan, "NaN"),
        (_shear, r"not a rotation: R\^T R differs"),
        (_row, "last row"),
    ],
)
def test_a_pose_that_is_not_rigid_names_its_view(arrays, spoil, message):
    spoil(arrays["base_from_tool"])
    with pytest.raises(ValueError, match=rf"view two: .*{message}"):
        Dataset.from_arrays(**arrays, view_ids=["zero", "one", "two", "three"])


def test_wrong_values_can_mask_their_view_instead(arrays):
    _nan(arrays["base_from_tool"])
    arrays["pixels"][0, 4] = [900.0, 20.0]
    data = Dataset.from_arrays(**arrays, bad_views="mask")
    assert [view for view, _ in data.masked_views] == ["0", "2"]
    assert "point 4 at (900.0, 20.0) px lies outside the 640 x 480" in data.masked_views[0][1]
    assert not data.visible[jnp.array([0, 2])].any()
    assert np.isfinite(data.base_from_tool.wxyz_xyz).all()
    np.testing.assert_array_equal(data.usable_views(), [1, 3])


def test_a_pixel_outside_the_picture_is_an_error(arrays):
    arrays["pixels"][1, 3] = [12.0, 500.0]
    with pytest.raises(ValueError, match=r"view 1: point 3 at \(12\.0, 500\.0\) px"):
        Dataset.from_arrays(**arrays)


@pytest.mark.parametrize("bad_views", ["raise", "mask"])
def test_an_exchanged_width_and_height_is_named(arrays, bad_views):
    arrays |= {"pixels": arrays["pixels"] * [1.3, 0.9], "image_size": (480, 640)}
    with pytest.raises(ValueError, match=r"480 x 640, but .*: are width and height exchanged"):
        Dataset.from_arrays(**arrays, bad_views=bad_views)


def test_duplicate_and_missing_ids(arrays):
    with pytest.raises(ValueError, match="view_ids: b given more than once"):
        Dataset.from_arrays(**arrays, view_ids=["a", "b", "b", "c"])
    with pytest.raises(ValueError, match="view_ids: expected 4, found 2"):
        Dataset.from_arrays(**arrays, view_ids=["a", "b"])


def test_visible_without_a_pixel_is_an_error(arrays):
    arrays["pixels"][2, 5] = np.nan
    with pytest.raises(ValueError, match="view 2: point 5 is marked visible but has no pixel"):
        Dataset.from_arrays(**arrays, visible=np.ones((VIEWS, POINTS), dtype=bool))


def test_wrong_mount_and_picture_size(arrays):
    with pytest.raises(ValueError, match="eye_in_hand, eye_to_hand; found 'ceiling'"):
        Dataset.from_arrays(**{**arrays, "mount": "ceiling"})
    with pytest.raises(ValueError, match="bad_views is 'raise' or 'mask'; found 'drop'"):
        Dataset.from_arrays(**arrays, bad_views="drop")
    with pytest.raises(ValueError, match="image_size"):
        Dataset.from_arrays(**{**arrays, "image_size": (0, 480)})


@pytest.fixture
def by_joints(arrays):
    joints = np.random.default_rng(1).uniform(-1.0, 1.0, (VIEWS, 7))
    return {**arrays, "base_from_tool": None, "joints": joints, "arm": kuka_lwr4()}


def test_joints_of_an_arm_take_the_place_of_poses(by_joints):
    data = Dataset.from_arrays(**by_joints)
    expected = kuka_lwr4().base_from_tool(by_joints["joints"])
    np.testing.assert_array_equal(data.base_from_tool.wxyz_xyz, expected.wxyz_xyz)
    np.testing.assert_array_equal(data.select([2, 0]).joints, by_joints["joints"][[2, 0]])
    np.testing.assert_array_equal(data.command.joints, by_joints["joints"])
    assert data.observations.joints is data.joints


def test_poses_next_to_joints_must_be_the_arms(by_joints):
    poses = np.array(kuka_lwr4().base_from_tool(by_joints["joints"]).as_matrix())
    poses[1, 0, 3] += 4e-4
    Dataset.from_arrays(**{**by_joints, "base_from_tool": poses})
    poses[2, 0, 3] += 0.02
    with pytest.raises(
        ValueError, match=r"view 2: the reported pose differs by .*check the tool frame"
    ):
        Dataset.from_arrays(**{**by_joints, "base_from_tool": poses})


def test_a_view_without_joints_is_masked_or_an_error(by_joints):
    by_joints["joints"][3, 2] = np.nan
    with pytest.raises(ValueError, match="view 3: the pose contains NaN"):
        Dataset.from_arrays(**by_joints)
    data = Dataset.from_arrays(**by_joints, bad_views="mask")
    assert [view for view, _ in data.masked_views] == ["3"]
    assert np.isfinite(data.base_from_tool.wxyz_xyz).all()
    assert np.isfinite(data.joints).all()


def test_joints_and_arm_go_together(by_joints, arrays):
    with pytest.raises(ValueError, match="found joints alone"):
        Dataset.from_arrays(**{**by_joints, "arm": None})
    with pytest.raises(ValueError, match="found an arm alone"):
        Dataset.from_arrays(**arrays, arm=kuka_lwr4())
    with pytest.raises(ValueError, match="found neither"):
        Dataset.from_arrays(**{**arrays, "base_from_tool": None})
    with pytest.raises(ValueError, match=r"joints: expected shape \(4, 7\).*found \(4, 6\)"):
        Dataset.from_arrays(**{**by_joints, "joints": by_joints["joints"][:, :6]})


def test_views_are_left_out_by_name(arrays):
    data = Dataset.from_arrays(**arrays, view_ids=["a", "b", "c", "d"])
    rest = data.without(["c", "a"])
    assert rest.view_ids == ("b", "d")
    np.testing.assert_array_equal(rest.pixels, data.pixels[np.array([1, 3])])
    assert data.without("b").view_ids == ("a", "c", "d")
    assert data.without([]).view_ids == data.view_ids
    with pytest.raises(ValueError, match="no view is called 'e', 'f'"):
        data.without(["a", "f", "e"])


def test_a_data_set_is_printed_in_ten_lines(arrays):
    views, notes = 40, [f"note {k}" for k in range(9)]
    arrays["pixels"] = np.tile(arrays["pixels"][:1], (views, 1, 1))
    arrays["base_from_tool"] = np.tile(np.eye(4), (views, 1, 1))
    arrays["base_from_tool"][:, 0, 3] = np.linspace(0.0, 0.25, views)
    masked = [(str(k), "blurred") for k in range(1, 8)]
    text = str(Dataset.from_arrays(**arrays, masked_views=masked, notes=notes, target="a board"))
    assert len(text.splitlines()) <= 10
    assert max(map(len, text.splitlines())) <= 100
    for words in (
        "eye_in_hand data set: 40 views (7 of them not used), 640 x 480 px",
        "points: 198 seen, 6 in every view",
        "robot: poses over (250, 0, 0) mm",
        "0, 1, 2, 3, 4, ..., 35, 36, 37, 38, 39",
        "view 2: blurred (and 5 more)",
        "note: note 1 (and 7 more)>",
    ):
        assert words in text
    # Without any view that is used there is nothing to measure.
    none = [(str(k), "blurred") for k in range(views)]
    assert "no points are seen" in str(Dataset.from_arrays(**arrays, masked_views=none))


def test_a_traced_data_set_can_be_printed(arrays):
    data = Dataset.from_arrays(**arrays)
    shown = []
    eqx.filter_jit(lambda traced: shown.append(repr(traced)) or traced.pixels)(data)
    assert "f64[4,6,2]" in shown[0]
