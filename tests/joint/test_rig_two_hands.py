"""A camera on one hand and a target on another in one fit with a camera next to the other arm."""

import dataclasses

import numpy as np
import pytest
from host_poses import transform_errors
from numpy_camera import project_radial
from scipy.optimize import least_squares
from two_hands_scene import (
    BOARD,
    KNOWN,
    NOISE,
    ROTATION,
    TRANSFORMS,
    TRANSLATION,
    hands_fit,
    hands_rig,
    stepped,
    two_hands,
)

import smartview_jax as sv
from smartview_jax.engine import STEP_NAMES
from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms

NAMES = {
    "camera_from_tool": "wrist.camera_from_tool",
    "other_tool_from_world": "tool_from_world",
    "camera_from_base": "fixed.camera_from_base",
}
"""The rig's names of transforms."""


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    return hands_fit(tmp_path_factory)


def scipy_fit(rig, truths):
    """The steps of four transforms from the truth by SciPy, their covariance, and the cost."""
    wrist, fixed = rig.cameras["wrist"], rig.cameras["fixed"]
    X, Z, B = (host_matrices(truths["wrist"].transforms[name]) for name in TRANSFORMS)
    F = host_matrices(truths["fixed"].camera_from_base)
    own, other = (
        host_matrices(poses)
        for poses in (wrist.hands.base_from_tool, wrist.hands.other_base_from_other_tool)
    )
    held = host_matrices(fixed.base_from_tool)
    middle = np.tile(np.eye(4), (len(own), 1, 1))
    middle[:, :3, 3] = 0.5 * (np.linalg.inv(own) @ B @ other)[:, :3, 3]
    camera = truths["wrist"].camera
    numbers = np.array([camera.alpha_u, camera.alpha_v, camera.u0, camera.v0, camera.lens.k1])

    def missed(chain, data):
        """Whitened residuals of one camera."""
        seen = np.einsum("vij,pj->vpi", chain[:, :3, :3], BOARD.points) + chain[:, None, :3, 3]
        off = np.asarray(data.pixels) - project_radial(numbers, seen)
        return off[np.asarray(data.visible)].ravel() / NOISE.pixel

    def residuals(x):
        """The residuals of both cameras, and the priors of the errors of their states."""
        x_step, z_step, b_step, f_step = x[:24].reshape(4, 6)
        of_pair, of_arm = np.split(x[24:].reshape(-1, 6), [len(own)])
        moved = middle @ host_exponentials(of_pair) @ np.linalg.inv(middle)
        between = np.linalg.inv(own) @ stepped(B, b_step) @ other
        pose = stepped(Z, z_step)
        sigmas = np.repeat([NOISE.translation, NOISE.rotation], 3)
        own_sigmas = np.repeat([TRANSLATION, ROTATION], 3)
        return np.concatenate(
            [
                missed(stepped(X, x_step) @ moved @ between @ pose, wrist),
                missed(stepped(F, f_step) @ held @ host_exponentials(of_arm) @ pose, fixed),
                (of_pair / sigmas).ravel(),
                (of_arm / own_sigmas).ravel(),
            ]
        )

    count = 24 + 6 * (len(own) + len(held))
    found = least_squares(lambda x: residuals(1e-3 * x), np.zeros(count), xtol=1e-14, ftol=1e-14)
    covariance = 1e-6 * np.linalg.inv(found.jac.T @ found.jac)[:24, :24]
    return (1e-3 * found.x)[:24].reshape(4, 6), covariance, found.cost


def test_scipy_finds_the_same_optimum_and_covariance(fit):
    rig, truths = hands_rig(0)
    steps, covariance, cost = scipy_fit(rig, truths)
    assert fit.solution.costs[-1] == pytest.approx(cost, rel=1e-8)
    expected = {**truths["fixed"].transforms, **truths["wrist"].transforms}
    found = {**fit.calibrations["fixed"].transforms, **fit.calibrations["wrist"].transforms}
    for k, name in enumerate((*TRANSFORMS, "camera_from_base")):
        own = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        std = np.sqrt(np.diagonal(own))
        optimum = host_transforms(stepped(host_matrices(expected[name]), steps[k]))
        assert np.abs(transform_errors(found[name], optimum) / std).max() < 1e-3
        if name in NAMES:
            rows = [fit.parameter_names.index(f"{NAMES[name]}.{step}") for step in STEP_NAMES]
            stated = fit.covariance[np.ix_(rows, rows)]
        else:
            stated = fit.base("left", "right").covariance
        np.testing.assert_allclose(stated / np.outer(std, std), own / np.outer(std, std), atol=1e-3)


def test_the_target_on_a_hand_is_one_for_both_cameras(fit):
    wrist, fixed = fit.calibrations["wrist"], fit.calibrations["fixed"]
    a, b = host_matrices(wrist.other_tool_from_world), host_matrices(fixed.tool_from_world)
    np.testing.assert_allclose(a, b, atol=1e-12)
    base = fit.base("left", "right")
    np.testing.assert_allclose(
        host_matrices(wrist.base_from_other_base), host_matrices(base.transform), atol=1e-9
    )
    # The camera next to the arm tells more of the target than the camera on the hand does alone.
    alone = sv.fit_joint(two_hands(0, 8).data, wrist, noise=NOISE, field=None, fixed=("camera",))
    for step in STEP_NAMES[:3]:
        assert fit.std[f"tool_from_world.{step}"] < alone.std[f"other_tool_from_world.{step}"]


def test_a_pair_of_arms_alone_is_fitted_as_one_data_set():
    scene = two_hands(0, 8)
    rig = sv.Rig({"wrist": scene.data}, arms={"wrist": ("left", "right")})
    both = sv.fit_rig(
        rig, {"wrist": scene.calibration}, noise=NOISE, field=None, fixed=("wrist.camera",)
    )
    alone = sv.fit_joint(scene.data, scene.calibration, noise=NOISE, field=None, fixed=("camera",))
    assert both.solution.costs[-1] == pytest.approx(alone.solution.costs[-1], rel=1e-10)
    np.testing.assert_allclose(both.covariance, alone.covariance, rtol=1e-4, atol=1e-14)
    base = both.base("left", "right")
    stds = [alone.std[f"base_from_other_base.{step}"] for step in STEP_NAMES]
    np.testing.assert_allclose(base.std, stds, rtol=1e-6)


def test_starts_are_found(fit):
    """Of the bases, of the target on the hand and of both cameras, whose lenses are known."""
    rig, truths = hands_rig(0)
    cameras = {name: truth.camera for name, truth in truths.items()}
    found = sv.calibrate(rig, camera=cameras, **{k: KNOWN[k] for k in ("noise", "field")})
    np.testing.assert_allclose(
        host_matrices(found.base("left", "right").transform),
        host_matrices(fit.base("left", "right").transform),
        atol=1e-6,  # of standard deviations of 2e-4 and more
    )
    assert found.solution.costs[-1] == pytest.approx(fit.solution.costs[-1], rel=1e-6)


def test_a_fit_of_two_hands_is_saved_and_read_again(fit, tmp_path):
    fit.save(tmp_path)
    base = sv.RelativePose.load(tmp_path / "base_right_from_base_left.yaml")
    np.testing.assert_allclose(base.covariance, fit.base("right", "left").covariance)
    pair = sv.load_rig_estimate(tmp_path / "left+right.joint.yaml")
    assert list(pair.calibrations) == ["wrist"]
    own = sv.load_estimate(tmp_path / "wrist.yaml")
    rows = [own.parameter_names.index(f"base_from_other_base.{step}") for step in STEP_NAMES]
    stated, std = own.covariance[np.ix_(rows, rows)], fit.base("left", "right").std
    expected = fit.base("left", "right").covariance / np.outer(std, std)
    np.testing.assert_allclose(stated / np.outer(std, std), expected, atol=1e-3)
    text = str(fit)
    assert "\nbase_right_from_base_left: " in text
    assert "\nleft+right: 0.141 mm" in text


def test_poses_of_one_state_are_one():
    """Also of a hand that another camera sees: the same view id is the same state."""
    rig, _ = hands_rig(0)
    wrist, fixed = rig.cameras["wrist"], rig.cameras["fixed"]
    same = dataclasses.replace(fixed, view_ids=wrist.view_ids[:6])
    with pytest.raises(ValueError, match="view '0' is one state of the arm right, but its pose"):
        sv.Rig({"wrist": wrist, "fixed": same}, arms=dict(rig.arms))


def test_a_view_without_its_target_has_the_pose_of_its_state():
    """A camera that did not see the target says nothing else about the robot than the others."""
    wrist = hands_rig(0)[0].cameras["wrist"]
    hands = wrist.hands
    alone = dataclasses.replace(
        wrist, mount="eye_in_hand", base_from_tool=hands.base_from_tool, hands=None
    )
    alone = dataclasses.replace(
        alone.mask_views([2]), masked_views=((wrist.view_ids[2], "no target was found"),)
    )
    second = alone.between_hands(host_matrices(hands.other_base_from_other_tool))
    both = {"wrist": wrist, "second": second}
    rig = sv.Rig(both, arms=dict.fromkeys(both, ("left", "right")))
    assert rig.view_ids == wrist.view_ids
    with pytest.raises(ValueError, match="other_base_from_other_tool: expected shape"):
        alone.between_hands(np.eye(4))


def test_starts_of_another_mount_and_without_bases_are_named():
    rig, truths = hands_rig(0)
    with pytest.raises(ValueError, match="camera 'wrist': mount: the start is eye_to_hand, but"):
        sv.fit_rig(rig, dict.fromkeys(truths, truths["fixed"]), **KNOWN)
    apart = dataclasses.replace(truths["wrist"], base_from_other_base=None)
    with pytest.raises(ValueError, match="camera 'wrist' is on one of two arms: give their bases"):
        sv.fit_rig(rig.of_arm("left+right"), {"wrist": apart}, noise=NOISE)


def test_arms_of_a_camera_between_hands_are_named():
    rig, _ = hands_rig(0)
    wrist, fixed = rig.cameras["wrist"], rig.cameras["fixed"]
    with pytest.raises(
        ValueError, match="camera 'wrist' is on one arm's hand and sees a target on"
    ):
        sv.Rig({"wrist": wrist})
    with pytest.raises(
        ValueError, match=r"'wrist' is hand_to_hand: expected two arms, .* found le"
    ):
        sv.Rig({"wrist": wrist}, arms={"wrist": "left"})
    with pytest.raises(ValueError, match="'fixed' is eye_to_hand: expected one arm, found left, r"):
        sv.Rig({"fixed": fixed}, arms={"fixed": ("left", "right")})
    with pytest.raises(ValueError, match="target 'cube' is on the hand of 'right' and, for camera"):
        sv.Rig(
            {"wrist": wrist, "fixed": fixed},
            dict.fromkeys(("wrist", "fixed"), "cube"),
            {"wrist": ("left", "right"), "fixed": "left"},
        )
    alone = {"wrist": ("left", "right"), "fixed": "third"}
    with pytest.raises(ValueError, match="no target tells where third and left, right are"):
        sv.Rig({"wrist": wrist, "fixed": fixed}, arms=alone)
