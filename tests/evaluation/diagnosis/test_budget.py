import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from standard_scene import POINTS, VIEWS
from starts import nudged

from smartview_jax import Noise, error_budget, fit_joint, held_out
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.evaluation.diagnosis import budget as budget_module
from smartview_jax.evaluation.diagnosis.causes import (
    SCALE_ERROR,
    SYSTEMATIC_ROBOT_ERROR,
    TOO_FEW_VIEWS,
)
from smartview_jax.evaluation.diagnosis.scale_hypotheses import ScaleHypothesis, region_held_out_rms
from smartview_jax.robot_errors import GenericSixAxisArm, LinearInPose, RobotError
from smartview_jax.simulation import paper_calibration, random_scene

SMALL = {"translation_noise": 2e-5, "rotation_noise": 5e-5}
PRINTED = 0.97


def budget(scene):
    start = nudged(dataclasses.replace(scene.calibration, robot_error=None))
    fit = fit_joint(scene.data, start, noise="estimated")
    return scene, fit, error_budget(scene.data, fit)


def sizes(found):
    return {part.name: part.rms for part in found.causes}


@pytest.fixture(scope="module")
def misprinted():
    """A target smaller than it is said to be, and the fit does not know."""
    truth = dataclasses.replace(paper_calibration(), target_scale=jnp.asarray(PRINTED))
    return budget(random_scene(2, VIEWS, POINTS, truth, **SMALL))


def test_a_misprinted_target_is_one_of_two_explanations(misprinted):
    found = misprinted[2]
    assert found.dominant_cause == SCALE_ERROR
    assert "measure the board" in found.summary
    target, robot = found.scale_hypotheses
    assert target.region_rms is None
    assert abs(target.scale - PRINTED) < 4.0 * target.std < 0.02
    # What a ruler decides: the robot would go farther than it says, by as much.
    assert robot.scale == pytest.approx(1.0 / PRINTED, abs=0.01)
    assert (
        abs(target.log_likelihood_ratio - robot.log_likelihood_ratio)
        < 0.5 * target.log_likelihood_ratio
    )
    assert target.log_likelihood_ratio > 10.0


def test_what_explains_predicts_regions_that_it_never_saw(misprinted, monkeypatch):
    """Better than a chain that leaves the error to the mount; no better than its pixels."""
    scene, fit, found = misprinted
    bare = held_out(scene.data, lambda part: trusting(part, fit), 3, by="region").errors.rms

    def in_three_regions(data, fit, name):
        """Only for the target: its fits are like the robot's."""
        return region_held_out_rms(data, fit, name, 3) if name == "target scale" else 7.0

    monkeypatch.setattr(budget_module, "scale_hypotheses", lambda *_: found.scale_hypotheses)
    monkeypatch.setattr(budget_module, "region_held_out_rms", in_three_regions)
    target, robot = error_budget(scene.data, fit, held_out_by_region=True).scale_hypotheses
    assert 0.15 < target.region_rms < bare
    assert robot.region_rms == 7.0


def trusting(data, fit):
    """Poses that are exact, by the program that knows corrections."""
    exact = Noise(0.15, 1e-9, 1e-9)
    return fit_joint(data, fit.calibration.uncorrected, noise=exact, gross_errors="keep")


def test_the_parts_of_a_budget_make_up_the_whole(misprinted):
    found = misprinted[2]
    whole = np.sqrt(sum(part.rms**2 for part in found.causes))
    assert whole == pytest.approx(found.total_rms, rel=0.3)
    assert [part.rms for part in found.causes] == sorted(sizes(found).values())[::-1]


def erring(field, coefficients):
    error = RobotError(field, jnp.asarray(coefficients))
    truth = dataclasses.replace(paper_calibration(), robot_error=error)
    return random_scene(0, VIEWS, POINTS, truth, **SMALL)


def test_a_robot_that_errs_in_its_own_way_is_the_culprit(scene):
    field = LinearInPose.from_poses(scene.data.base_from_tool)
    by_group = np.repeat([4e-4, 8e-4, 3e-4, 6e-4], [count for _, count in field.groups])
    coefficients = by_group * np.random.default_rng(1).normal(size=field.size)
    _, _, found = budget(erring(field, coefficients))
    assert found.dominant_cause == SYSTEMATIC_ROBOT_ERROR
    assert sizes(found)[SCALE_ERROR] == 0.0
    assert "have the robot calibrated" in found.summary
    assert (
        found.scale_hypotheses[0].log_likelihood_ratio
        < 0.5 * found.scale_hypotheses[0].field_log_likelihood_ratio
    )


def test_an_arm_that_nobody_described_is_judged_by_a_linear_chain(scene):
    """Its own bare chain is farther off: lengths take from the mount what they give."""
    field = GenericSixAxisArm.from_poses(scene.data.base_from_tool)
    arm_scene = erring(field, 1e-3 * np.random.default_rng(1).normal(size=field.size))
    data, (_, fit, found) = arm_scene.data, budget(arm_scene)
    assert isinstance(fit.calibration.robot_error.field, GenericSixAxisArm)
    assert found.dominant_cause == SYSTEMATIC_ROBOT_ERROR
    assert found.total_rms < reprojection_errors(fit.calibration.uncorrected, data).rms


def test_a_free_size_is_no_cause_where_a_field_explains_far_more():
    """A size that is averaged over is free as well, though it may be as stated."""
    size = ScaleHypothesis("target scale", 0.96, 0.008, 24.0, 217.0, 18.0, 20.6, None)
    stretch = size._replace(name="robot stretch", log_likelihood_ratio=200.0)
    for size_is_free in (False, True):
        accepted = budget_module._accepted_hypothesis((size, stretch), size_is_free)
        assert accepted == (None if size_is_free else stretch)
    likelier = size._replace(log_likelihood_ratio=150.0)
    assert budget_module._accepted_hypothesis((likelier, stretch), True) == likelier


def test_few_views_come_before_all_else(misprinted):
    scene, fit, _ = misprinted
    few = scene.data.mask_views(range(6, VIEWS))
    found = error_budget(few, fit)
    assert found.dominant_cause == TOO_FEW_VIEWS
    assert found.scale_hypotheses == ()
    assert "6 views" in found.summary


def test_a_view_that_was_rejected_does_not_count(misprinted, monkeypatch):
    scene, fit, found = misprinted
    monkeypatch.setattr(budget_module, "scale_hypotheses", lambda *_: found.scale_hypotheses)
    without = scene.data.mask_views([3])
    used = fit.problem.observations.visible.at[3].set(False)
    refused = eqx.tree_at(lambda f: f.problem.observations.visible, fit, used)
    wrong = eqx.tree_at(lambda d: d.pixels, scene.data, scene.data.pixels.at[3].add(40.0))
    assert error_budget(wrong, refused).total_rms == error_budget(without, fit).total_rms
    assert error_budget(wrong, fit).total_rms > 1.1 * found.total_rms


def test_a_fit_that_trusts_the_robot_has_no_budget(misprinted):
    scene, fit, _ = misprinted
    with pytest.raises(ValueError, match='needs a fit with noise="estimated"'):
        error_budget(scene.data, dataclasses.replace(fit, noise_estimate=None))
