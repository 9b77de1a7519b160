import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from starts import nudged

from smartview_jax import error_budget, fit_joint, fit_staged, held_out
from smartview_jax.evaluation import deviations
from smartview_jax.evaluation.diagnosis.budget import SCALE, SYSTEMATIC, VIEWS
from smartview_jax.robot_errors import ImpliedArm, LinearInPose, RobotError
from smartview_jax.simulation import paper_calibration, paper_points, random_scene, six_axis_scene

VIEWS_TAKEN = 16
POINTS = paper_points((0.0, 0.02))[::4]
SMALL = {"translation_noise": 2e-5, "rotation_noise": 5e-5}
PRINTED = 0.97


def budget(scene):
    start = nudged(dataclasses.replace(scene.calibration, robot_error=None))
    fit = fit_joint(scene.data, start, noise="estimated")
    return scene, fit, error_budget(scene.data, fit)


def sizes(found):
    return {part.name: part.px for part in found.parts}


@pytest.fixture(scope="module")
def misprinted():
    """A target smaller than it is said to be, and the fit does not know."""
    truth = dataclasses.replace(paper_calibration(), target_scale=jnp.asarray(PRINTED))
    return budget(random_scene(2, VIEWS_TAKEN, POINTS, truth, **SMALL))


def test_a_misprinted_target_is_one_of_two_explanations(misprinted):
    found = misprinted[2]
    assert found.culprit == SCALE
    assert "measure the board" in found.words
    target, robot = found.explanations
    assert target.region_px is None
    assert abs(target.size - PRINTED) < 4.0 * target.std < 0.02
    # What a ruler decides: the robot would go farther than it says, by as much.
    assert robot.size == pytest.approx(1.0 / PRINTED, abs=0.01)
    assert abs(target.gain - robot.gain) < 0.5 * target.gain
    assert target.gain > 10.0


def test_what_explains_predicts_regions_that_it_never_saw(misprinted):
    """Better than a chain that leaves the error to the mount; no better than its pixels."""
    scene, fit, _ = misprinted
    target = error_budget(scene.data, fit, regions=True).explanations[0]
    bare = held_out(scene.data, lambda part: trusting(part, fit), 5, by="region").deviations.rms
    assert target.region_px is not None
    assert 0.15 < target.region_px < bare


def trusting(data, fit):
    return fit_joint(data, fit.calibration.uncorrected, noise="trusted", bad_views="keep")


def test_its_parts_make_up_the_whole(misprinted):
    found = misprinted[2]
    whole = np.sqrt(sum(part.px**2 for part in found.parts))
    assert whole == pytest.approx(found.total, rel=0.3)
    assert [part.px for part in found.parts] == sorted(sizes(found).values())[::-1]


def test_a_robot_that_errs_in_its_own_way_is_the_culprit():
    poses = random_scene(0, VIEWS_TAKEN, POINTS).data.base_from_tool
    field = LinearInPose.over(poses)
    by_group = np.repeat([4e-4, 8e-4, 3e-4, 6e-4], [count for _, count in field.groups])
    coefficients = by_group * np.random.default_rng(1).normal(size=field.size)
    error = RobotError(field, jnp.asarray(coefficients))
    truth = dataclasses.replace(paper_calibration(), robot_error=error)
    _, _, found = budget(random_scene(0, VIEWS_TAKEN, POINTS, truth, **SMALL))
    assert found.culprit == SYSTEMATIC
    assert sizes(found)[SCALE] == 0.0
    assert "have the robot calibrated" in found.words
    assert found.explanations[0].gain < 0.5 * found.explanations[0].field_gain


def test_an_arm_that_nobody_described_is_judged_by_a_linear_chain():
    """Its own bare chain is farther off: lengths take from the mount what they give."""
    data = six_axis_scene(0).data
    fit = fit_joint(data, fit_staged(data, "opencv4").calibration, noise="estimated")
    assert isinstance(fit.calibration.robot_error.field, ImpliedArm)
    found = error_budget(data, fit)
    assert found.culprit == SYSTEMATIC
    assert found.total < deviations(fit.calibration.uncorrected, data).rms


def test_few_views_come_before_all_else(misprinted):
    scene, fit, _ = misprinted
    few = scene.data.without(range(6, VIEWS_TAKEN))
    found = error_budget(few, fit)
    assert found.culprit == VIEWS
    assert found.explanations == ()
    assert "6 views" in found.words


def test_a_fit_that_trusts_the_robot_has_no_budget(misprinted):
    scene, fit, _ = misprinted
    with pytest.raises(ValueError, match='needs a fit with noise="estimated"'):
        error_budget(scene.data, dataclasses.replace(fit, estimate=None))
