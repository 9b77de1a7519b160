import dataclasses
import itertools

import equinox as eqx
import numpy as np
import pytest
import scipy.special
from fit_scenes import MANY_VIEWS, scene_of, thinned
from linear_world import drawn, linearised
from starts import nudged

from smartview_jax import Noise, fit_joint
from smartview_jax.engine import with_lens
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.robot_errors import CombinedField, GenericSixAxisArm, LinearInPose
from smartview_jax.simulation import six_axis_scene
from smartview_jax.variance.fisher_scoring import (
    LikelihoodMaximum,
    StandardDeviationPrior,
    maximise,
)
from smartview_jax.variance.likelihood import marginalise
from smartview_jax.variance.model_selection import (
    MIN_GENERIC_ARM_VIEWS,
    FittedCandidate,
    ModelName,
    average_standard_deviations,
    drop_negligible,
    log_evidence,
    posterior_probabilities,
)
from smartview_jax.variance.standard_deviations import ROBOT_SIGMA_FLOOR, StandardDeviations
from smartview_jax.variance.variance_components import estimate_noise


@pytest.fixture(scope="module")
def arms():
    made = [six_axis_scene(seed, MANY_VIEWS, error_scale=1.5) for seed in (0, 1)]
    return [dataclasses.replace(scene, data=thinned(scene.data, 7)) for scene in made]


def start_of(scene):
    """Near the truth, with a lens that is not quite the true one, and no word of the arm."""
    return with_lens(nudged(scene.calibration.uncorrected), "opencv4")


def test_an_arm_that_nobody_described_makes_the_mount_better(arms):
    """Poses alone: its proportions are not the simulated arm's, only its build is."""
    mount, pixels = [], []
    for scene in arms:
        start = start_of(scene)
        linear = LinearInPose.from_poses(scene.data.base_from_tool)
        # A field that is held at zero is none, and by the program of the next fit.
        held = Noise(0.05, 1e-9, 1e-9, field=(1.0,) * len(linear.groups))
        trusting = fit_joint(scene.data, start, noise=held, field=linear, fixed=("robot_error",))
        by_pose = fit_joint(scene.data, start, noise="estimated", field=linear)
        by_arm = fit_joint(scene.data, start, noise="estimated")
        assert by_arm.noise_estimate.name == "six_axis_arm"
        truth = scene.calibration.camera_from_tool.translation()
        found = [fit.calibration for fit in (trusting, by_pose, by_arm)]
        mount.append([np.linalg.norm(c.camera_from_tool.translation() - truth) for c in found])
        pixels.append([reprojection_errors(c, scene.held_out).rms for c in found])
    trusting, by_pose, by_arm = np.sqrt(np.mean(np.square(mount), axis=0))
    assert by_arm < 0.6 * trusting
    assert by_arm < by_pose
    trusting, by_pose, by_arm = np.sqrt(np.mean(np.square(pixels), axis=0))
    assert by_arm < 0.5 * by_pose < 0.5 * trusting


def test_few_views_are_given_no_arm(arms):
    shown, start = MIN_GENERIC_ARM_VIEWS - 1, start_of(arms[0])
    data = arms[0].data.mask_views(range(shown, MANY_VIEWS))
    found = estimate_noise(data, start)
    assert "six_axis_arm" not in [other.name for other in found.candidates]
    poses = data.base_from_tool
    asked = CombinedField(LinearInPose.from_poses(poses), GenericSixAxisArm.from_poses(poses))
    found = estimate_noise(data, start, field=asked)
    assert isinstance(found.field, CombinedField)


def test_who_holds_the_robots_error_is_given_no_other(arms):
    scene, fixed = arms[0], ("robot_error",)
    with pytest.raises(ValueError, match="no parameter is called 'robot_error'"):
        estimate_noise(scene.data, scene.calibration.uncorrected, fixed=fixed)
    scene = scene.with_joint_readings
    # The search for gross errors has programs of its own.
    found = fit_joint(scene.data, scene.calibration, fixed=fixed, gross_errors="keep")
    assert eqx.tree_equal(found.calibration.robot_error, scene.calibration.robot_error)
    assert found.noise_estimate.name == "white"
    assert reprojection_errors(found.calibration, scene.held_out).rms < 0.1


def test_white_noise_is_not_taken_for_an_arm():
    scene = scene_of(3, MANY_VIEWS, translation_noise=1e-4, rotation_noise=2e-4)
    fits = [
        fit_joint(scene.data, nudged(scene.calibration), noise="estimated", field=field)
        for field in ("auto", None)
    ]
    found = {one.name: one.probability for one in fits[0].noise_estimate.candidates}
    assert fits[0].noise_estimate.name == "white"
    assert found["six_axis_arm"] < 0.05
    unseen = scene_of(50, 30, pixel_noise=0.0).data
    averaged, white = (reprojection_errors(fit.calibration, unseen).rms for fit in fits)
    assert averaged < 1.05 * white


def test_evidence_is_the_mass_of_the_posterior(world):
    """Laplace's method against the integral over a grid, of three sizes and of four."""
    views = linearised(world, drawn(world, 0))
    prior = StandardDeviationPrior(np.full(4, 0.3), np.full(4, 1.0), 0.7)
    start = StandardDeviations.from_vector(np.array([0.5, 0.3, 0.3, 0.3, 0.3]))

    def mass(grids):
        """Of pixels, translations and rotations, and of the first group where there is a grid."""
        logs = np.array(list(itertools.product(*grids)))
        numbers = np.full((len(logs), 5), ROBOT_SIGMA_FLOOR)
        numbers[:, : logs.shape[1]] = np.exp(logs)
        value = [
            -0.5 * marginalise(views, StandardDeviations.from_vector(row)).deviance
            for row in numbers
        ]
        off = (logs[:, 1:] - np.log(0.3)) ** 2
        value = value - 0.5 * off.sum(axis=1) - 0.7 * (logs[:, 0] - np.log(views.white_sigma))
        widths = 0.5 * np.log(2.0 * np.pi) * (logs.shape[1] - 1)
        cell = np.prod([grid[1] - grid[0] for grid in grids])
        return scipy.special.logsumexp(value) + np.log(cell) - widths

    differences = []
    for active, count in (([1, 1, 0, 0], 3), ([1, 1, 1, 0], 4)):
        active = np.array(active, dtype=bool)
        found = maximise(views, start, active, prior)
        width = np.sqrt(np.diagonal(np.linalg.inv(found.information[:count, :count])))
        at = np.log(found.sigmas.vector)[:count]
        # Of a normal density, steps of 4/3 standard deviations sum up to 1e-5 of the integral.
        grids = [np.linspace(a - 4.0 * w, a + 4.0 * w, 7) for a, w in zip(at, width, strict=True)]
        differences.append(mass(grids) - log_evidence(found, active, prior))
    np.testing.assert_allclose(differences, 0.0, atol=0.25)


WHITE, POSE = ModelName("white"), ModelName("pose")


def test_a_model_is_named_by_its_field_and_by_a_free_scale():
    assert [str(WHITE), str(POSE._replace(free_sizes=("target_scale",)))] == [
        "white",
        "pose with target_scale",
    ]


def test_sizes_are_averaged_by_their_variances():
    def tried(numbers):
        found = LikelihoodMaximum(
            StandardDeviations.from_vector(np.array(numbers)), 0.0, 0.0, np.zeros((0, 0)), 0
        )
        return FittedCandidate(np.ones(3, dtype=bool), found, 0.0)

    found = average_standard_deviations(
        {WHITE: tried([1.0, 3.0, 2.0, 0.0]), POSE: tried([2.0, 1.0, 2.0, 4.0])},
        {WHITE: 0.75, POSE: 0.25},
    )
    expected = np.sqrt([0.75 + 1.0, 0.75 * 9.0 + 0.25, 4.0, 4.0])
    np.testing.assert_allclose(found.vector, expected)


def test_weights_are_probabilities_and_small_ones_are_dropped():
    def tried(log_weight):
        return FittedCandidate(np.ones(3, dtype=bool), None, log_weight)

    rare = ModelName("position", ("target_scale",))
    found = posterior_probabilities({WHITE: tried(1000.0), POSE: tried(999.0), rare: tried(990.0)})
    share = np.exp([0.0, -1.0, -10.0])
    np.testing.assert_allclose(list(found.values()), share / share.sum())
    assert drop_negligible(found) == pytest.approx({WHITE: 0.7310586, POSE: 0.2689414})
