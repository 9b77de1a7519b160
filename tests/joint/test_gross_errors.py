import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import MANY_VIEWS, scene_of
from jaxlie import SE3
from starts import nudged

from smartview_jax import Calibration, Noise, fit_joint
from smartview_jax.engine import build_problem, padded, solve
from smartview_jax.geometry import as_se3, host_logarithms, host_matrices
from smartview_jax.joint.gross_errors import remove_gross_errors
from smartview_jax.variance import encompassing_field

SEEDS = (0, 1, 4)
ROBOT = {"translation_noise": 1e-4, "rotation_noise": 2e-4}


def mispaired(data, view, other):
    poses = data.base_from_tool.wxyz_xyz
    return eqx.tree_at(lambda d: d.base_from_tool.wxyz_xyz, data, poses.at[view].set(poses[other]))


@pytest.fixture(scope="module")
def spoilt():
    """Clean scenes, and the same with 10 % gross outliers and one view in 16 mispaired."""
    clean = [scene_of(seed, MANY_VIEWS, **ROBOT) for seed in SEEDS]
    dirty = [scene_of(seed, MANY_VIEWS, outlier_fraction=0.1, **ROBOT) for seed in SEEDS]
    return [(c, d, mispaired(d.data, 7, 3)) for c, d in zip(clean, dirty, strict=True)]


@pytest.fixture(scope="module")
def screenings(spoilt):
    return [(s[1], *remove_gross_errors(s[2], s[0].calibration)) for s in spoilt]


def test_every_gross_outlier_goes_and_next_to_nothing_else(screenings):
    false = 0
    for scene, data, _ in screenings:
        rest = np.arange(MANY_VIEWS) != 7
        gone = np.asarray(scene.data.visible & ~data.visible)[rest]
        outliers = np.asarray(scene.outliers)[rest]
        assert gone[outliers].all()
        false += int(gone[~outliers].sum())
    assert false <= 1


def test_the_mispaired_view_goes_with_its_reason(screenings):
    for _, data, _ in screenings:
        ((view, reason),) = data.masked_views
        assert view == "7"
        assert "it fits the pose of no other view either: moved, or a wrong pose?" in reason
        assert not np.asarray(data.visible)[7].any()


def test_a_fixed_camera_leaves_out_the_same_by_the_program_of_its_fit(
    spoilt, screenings, monkeypatch
):
    """The same pictures, as if the robot had held the target by the inverse poses."""
    clean, _, data = spoilt[0]
    turned = as_se3(np.linalg.inv(host_matrices(data.base_from_tool)))
    fixed = dataclasses.replace(data, mount="eye_to_hand", base_from_tool=turned)
    hand = clean.calibration
    start = Calibration.eye_to_hand(hand.camera, hand.camera_from_mount, hand.holder_from_world)
    problems = []

    def recorded(problem, *args, **kwargs):
        problems.append(problem)
        return solve(problem, *args, **kwargs)

    monkeypatch.setattr("smartview_jax.joint.gross_errors.solve", recorded)
    found, points = remove_gross_errors(fixed, start)
    _, expected, expected_points = screenings[0]
    np.testing.assert_array_equal(found.visible, expected.visible)
    assert [entry[:2] for entry in points] == [entry[:2] for entry in expected_points]
    field = encompassing_field(fixed, MANY_VIEWS)
    noise = Noise(1.0, 1.0, 1.0, field=(1.0,) * len(field.groups))
    later = build_problem(found, start, noise=noise, field=field).problem
    assert {jax.tree.structure(padded(x)) for x in problems} == {jax.tree.structure(padded(later))}


def test_points_are_listed_with_how_far_they_are(screenings):
    scene, data, points = screenings[0]
    gone = np.asarray(scene.data.visible & ~data.visible)
    assert {(view, point) for view, point, _ in points} == {
        (str(view), point) for view, point in np.argwhere(gone) if view != 7
    }
    for view, point, reason in points:
        shift = float(reason.split(" px")[0])
        assert shift >= 4.0, (view, point, reason)


def test_hand_eye_is_where_it_would_be_without_them(spoilt):
    """Within a fifth of a standard deviation, of a fit that is told what to leave out."""
    for _, scene, data in spoilt:
        known = data.with_visible(np.asarray(data.visible & ~scene.outliers)).mask_views([7])
        options = {"noise": "estimated", "field": None}
        start = nudged(scene.calibration)
        told = fit_joint(known, start, gross_errors="keep", **options)
        found = fit_joint(data, start, **options)
        moved = host_logarithms(
            np.linalg.inv(host_matrices(told.calibration.camera_from_tool))
            @ host_matrices(found.calibration.camera_from_tool)
        )
        parts = [np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])]
        stds = [
            np.sqrt(sum(told.std[f"camera_from_tool.{part}.{axis}"] ** 2 for axis in "xyz"))
            for part in ("translation", "rotation")
        ]
        assert (np.array(parts) <= 0.2 * np.array(stds)).all()


def test_a_trusting_fit_leaves_them_out_where_it_is_asked(spoilt):
    clean, _, data = spoilt[0]
    kept = fit_joint(clean.data, clean.calibration, fixed=("camera",), noise="trusted")
    robust = fit_joint(
        data, clean.calibration, fixed=("camera",), gross_errors="leave_out", noise="trusted"
    )
    assert [view for view, point, _ in robust.rejected if point is None] == ["7"]
    apart = (
        kept.calibration.camera_from_tool.inverse() @ robust.calibration.camera_from_tool
    ).log()
    assert np.linalg.norm(apart[:3]) < 1e-3
    # A view that was left out still shows how far off it is.
    assert float(jnp.abs(robust.residuals[7]).max()) > 50.0


def test_a_view_that_sees_nothing_from_where_the_robot_says_is_left_out(spoilt):
    clean = spoilt[0][0]
    behind = SE3(clean.data.base_from_tool.wxyz_xyz[2]) @ SE3.exp(
        jnp.array([0.0, 0.0, 0.0, jnp.pi, 0.0, 0.0])
    )
    data = eqx.tree_at(
        lambda d: d.base_from_tool.wxyz_xyz,
        clean.data,
        clean.data.base_from_tool.wxyz_xyz.at[2].set(behind.wxyz_xyz),
    )
    with pytest.raises(ValueError, match="every point of view 2 is behind"):
        fit_joint(data, clean.calibration, noise="trusted")
    found = fit_joint(data, clean.calibration, gross_errors="leave_out", noise="trusted")
    ((view, _, reason),) = [entry for entry in found.rejected if entry[1] is None]
    assert view == "2"
    assert "disagree" in reason


def test_an_unknown_treatment_of_gross_errors_is_named(spoilt):
    clean = spoilt[0][0]
    with pytest.raises(
        ValueError, match="gross_errors is one of auto, keep, leave_out; found 'mask'"
    ):
        fit_joint(clean.data, clean.calibration, gross_errors="mask", noise="trusted")
