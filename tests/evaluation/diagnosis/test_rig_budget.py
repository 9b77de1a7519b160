import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from standard_scene import POINTS

from smartview_jax import Rig, error_budget
from smartview_jax.engine import build_rig
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.evaluation.diagnosis import rig_budget
from smartview_jax.evaluation.diagnosis.causes import (
    PIXEL_NOISE,
    ROBOT_NOISE,
    SYSTEMATIC_ROBOT_ERROR,
    TOO_FEW_VIEWS,
)
from smartview_jax.evaluation.diagnosis.rig_budget import (
    CONTRADICTED_VALUES,
    OTHER_PRIORS,
    SIZES_OF_ERRORS,
    TARGET_SIZE,
    covariance_by_cause,
)
from smartview_jax.fit_result import Rejection
from smartview_jax.robot_errors import GenericSixAxisArm, LinearInPose, RobotError
from smartview_jax.simulation import simulate
from smartview_jax.variance import RigNoiseEstimate
from smartview_jax.variance.kenward_roger import SmallSampleCorrection


@pytest.fixture(scope="module")
def parts(fitted_rig):
    return covariance_by_cause(fitted_rig.fit)


def test_the_parts_are_those_of_a_linear_estimator(fitted_rig, parts):
    """Its gain on every independent error is found by differences of all residuals."""
    fit, problem = fitted_rig.fit, fitted_rig.fit.built.problem
    flat, unravel = ravel_pytree(fit.solution.z)
    whole = jax.jit(lambda x: [ravel_pytree(r)[0] for r in problem.residuals(unravel(x))])
    count, columns = len(fit.parameter_names), []
    steps = np.full(len(flat), 1e-6)
    steps[:count] = [0.01 * fit.std[name] for name in fit.parameter_names]
    for k, step in enumerate(steps):
        ahead, behind = (whole(flat.at[k].add(sign * step)) for sign in (1.0, -1.0))
        columns.append(
            np.concatenate([(a - b) / (2.0 * step) for a, b in zip(ahead, behind, strict=True)])
        )
    gain = np.linalg.pinv(np.stack(columns, axis=1) * steps)[:count] * steps[:count, None]
    pixels, shared, _ = np.cumsum([len(part) for part in whole(flat)])
    rows = {
        PIXEL_NOISE: np.arange(pixels),
        ROBOT_NOISE: np.arange(shared, gain.shape[1]),
        SYSTEMATIC_ROBOT_ERROR: [],
        TARGET_SIZE: [],
        OTHER_PRIORS: [],
    }
    for row, name in zip(np.asarray(problem.free), fit.parameter_names, strict=True):
        group = OTHER_PRIORS if "." in name else TARGET_SIZE
        group = SYSTEMATIC_ROBOT_ERROR if name.startswith("robot_error") else group
        rows[group].append(pixels + row)
    assert parts.keys() == rows.keys()
    std = np.array([fit.std[name] for name in fit.parameter_names])
    for cause, part in parts.items():
        expected = gain[:, rows[cause]] @ gain[:, rows[cause]].T
        np.testing.assert_allclose(
            part / np.outer(std, std), expected / np.outer(std, std), atol=1e-6
        )
    np.testing.assert_allclose(np.sum(list(parts.values()), axis=0), fit.covariance, rtol=1e-9)


def test_squares_of_causes_add_up_to_the_poses_own_deviations(fitted_rig):
    fit = fitted_rig.fit
    found = {pose.name: pose for pose in rig_budget.pose_uncertainties(fit)}
    assert list(found) == ["left.camera_from_tool", "right.camera_from_tool", "right in left"]
    for name in list(found)[:2]:
        expected = [
            np.linalg.norm([fit.std[f"{name}.{part}.{axis}"] for axis in "xyz"])
            for part in ("translation", "rotation")
        ]
        np.testing.assert_allclose(found[name][1:3], expected, rtol=1e-9)
    std = fit.relative("left", "right").std
    expected = np.linalg.norm(std[:3]), np.linalg.norm(std[3:])
    np.testing.assert_allclose(found["right in left"][1:3], expected, rtol=1e-9)
    for pose in found.values():
        squares = np.square([cause[1:] for cause in pose.causes]).sum(axis=0)
        np.testing.assert_allclose(np.sqrt(squares), pose[1:3], rtol=1e-9)
    # Cameras of one hand move together when the robot errs.
    of_robot = [
        next(cause for cause in pose.causes if cause.name == SYSTEMATIC_ROBOT_ERROR).translation
        for pose in found.values()
    ]
    assert of_robot[2] < 0.1 * min(of_robot[:2])


def test_estimated_sizes_of_errors_and_contradicted_values_are_causes(fitted_rig, parts):
    fit = fitted_rig.fit
    whole, size = np.asarray(fit.covariance), len(fit.parameter_names)
    added = SmallSampleCorrection(
        np.zeros(0), 0.25 * whole, np.zeros(size), np.zeros((0, 0)), np.zeros((0, size, size))
    )
    estimate = RigNoiseEstimate(
        "", fit.noise, None, {}, (), None, True, fit.built, fit.solution.z, added, 0.75 * whole
    )
    wider = dataclasses.replace(
        fit,
        covariance=2.5 * whole,
        contradicted_covariance=0.5 * whole,
        noise_estimates={next(iter(fit.noises)): estimate},
    )
    found = covariance_by_cause(wider)
    np.testing.assert_allclose(found.pop(CONTRADICTED_VALUES), 0.5 * whole, rtol=1e-9)
    np.testing.assert_allclose(found.pop(SIZES_OF_ERRORS), whole, rtol=1e-9)
    assert found.keys() == parts.keys()
    for cause, part in found.items():
        np.testing.assert_allclose(part, parts[cause], rtol=1e-6, atol=1e-9 * np.abs(part).max())


@pytest.fixture(scope="module")
def erring(fitted_rig):
    """Pictures that a rig with errors of all kinds takes, and a fit that knows them."""
    rig, truths, noise, options, fit = fitted_rig
    field, rng = options["field"], np.random.default_rng(0)
    coefficients = np.repeat(noise.field, [count for _, count in field.groups])
    error = RobotError(field, jnp.asarray(coefficients * rng.standard_normal(field.size)))
    truths = {name: dataclasses.replace(t, robot_error=error) for name, t in truths.items()}
    data = {}
    for seed, (name, one) in enumerate(rig.cameras.items()):
        scatter = np.repeat([noise.translation, noise.rotation], 3)
        seen = simulate(
            truths[name], one.base_from_tool, POINTS, seed, noise.pixel, *scatter[[0, 3]]
        ).data
        data[name] = dataclasses.replace(
            one, pixels=seen.pixels, visible=seen.visible & one.visible
        )
    return Rig(data), dataclasses.replace(fit, calibrations=truths)


def test_each_camera_has_a_budget_of_its_own(erring, monkeypatch):
    """The measures themselves are tested with one camera's budget, and take long to compile."""
    rig, fit = erring
    given = []

    def known(estimate, data, inliers):
        given.append((estimate, data, inliers))
        return {PIXEL_NOISE: 0.1 * len(given), SYSTEMATIC_ROBOT_ERROR: 0.25, TOO_FEW_VIEWS: 0.01}

    monkeypatch.setattr(rig_budget, "rms_of_causes", known)
    other = Rejection("2", None, "moved")
    found = error_budget(rig, dataclasses.replace(fit, rejected=(("right", other),)))
    assert list(found.cameras) == ["left", "right"]
    for (name, budget), (estimate, data, inliers) in zip(found.cameras.items(), given, strict=True):
        assert estimate.calibration is fit.calibrations[name]
        assert estimate.pixel_sigma == fit.pixel_sigmas[name]
        assert np.asarray(data.visible)[2].any() == (name == "left")
        np.testing.assert_array_equal(inliers, fit.inliers[name])
        bare = estimate.calibration.uncorrected
        assert budget.total_rms == reprojection_errors(bare, data).rms
        assert budget.uses_fitted_chain
    left, right = found.cameras.values()
    assert left.total_rms != right.total_rms
    assert left.dominant_cause == right.dominant_cause == SYSTEMATIC_ROBOT_ERROR
    assert "have the robot calibrated" in left.summary
    assert "Then pixel noise, 0.2 px: sharper pictures" in right.summary


def test_an_arm_that_nobody_described_is_judged_by_a_linear_chain(erring, monkeypatch):
    rig, fit = erring
    field = GenericSixAxisArm.from_poses(rig.base_from_tool)
    arms = {
        name: dataclasses.replace(calibration, robot_error=RobotError.zero(field))
        for name, calibration in fit.calibrations.items()
    }
    # The left camera was held: no name of its numbers is among the estimated ones.
    kept = [k for k, n in enumerate(fit.parameter_names) if not n.startswith("left.camera.")]
    held = dataclasses.replace(
        fit,
        parameter_names=tuple(fit.parameter_names[k] for k in kept),
        covariance=np.asarray(fit.covariance)[np.ix_(kept, kept)],
    )

    def linear_fit(used, starts, field, fixed):
        """The fit that is asked for could be made: its problem is built."""
        assert used.view_ids == rig.view_ids
        assert isinstance(field, LinearInPose)
        assert all(start.robot_error is None for start in starts.values())
        assert fixed == ["left.camera"]
        known = dataclasses.replace(fit.noise, field=(1e-3,) * len(field.groups))
        built = build_rig(used, starts, noise=known, field=field, fixed=fixed)
        assert not any(name.startswith("left.camera.") for name in built.shared_names)
        return fit

    monkeypatch.setattr(rig_budget, "fit_rig", linear_fit)
    causes = {PIXEL_NOISE: 0.1, ROBOT_NOISE: 0.2}
    monkeypatch.setattr(rig_budget, "rms_of_causes", lambda *_: causes)
    monkeypatch.setattr(rig_budget, "pose_uncertainties", lambda _: ())
    found = error_budget(rig, dataclasses.replace(held, calibrations=arms))
    for budget in found.cameras.values():
        assert not budget.uses_fitted_chain
        assert "with a field linear in the pose" in budget.summary


def test_a_rig_and_a_fit_of_one_camera_do_not_belong_together(erring):
    rig, fit = erring
    with pytest.raises(TypeError, match="or a rig with RigFit"):
        error_budget(rig.cameras["left"], fit)
