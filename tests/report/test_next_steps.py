"""What a report advises, against the numbers of the fit it is of."""

import dataclasses
import re

import numpy as np
import pytest
from standard_scene import POINTS, VIEWS

from smartview_jax import Noise, calibrate
from smartview_jax.fit_result import FitCode, FitResult
from smartview_jax.report import error_summaries
from smartview_jax.report.next_steps import hand_eye_half_widths, hand_eye_sentence, next_steps
from smartview_jax.simulation import random_scene

NOISE = Noise(pixel=0.1, translation=1e-3, rotation=1e-3)
LENS = "radial"


@pytest.fixture(scope="module")
def data():
    return random_scene(2, VIEWS, POINTS, translation_noise=1e-3, rotation_noise=1e-3).data


@pytest.fixture(scope="module")
def fit(data):
    return calibrate(data, LENS, noise=NOISE)


def test_the_least_known_axis_is_said(fit):
    names = [f"camera_from_tool.translation.{axis}" for axis in "xyz"]
    widest = max(fit.joint.confidence_half_width(name) for name in names)
    assert hand_eye_half_widths(fit.joint)[0] == widest
    assert f"camera_from_tool is known to {1e3 * widest:.2g} mm" in hand_eye_sentence(fit.joint)


def test_a_robot_that_errs_more_than_the_camera_is_what_limits(fit, data):
    sentences = next_steps(fit, data, error_summaries(fit, data))
    assert sentences[0].startswith("The robot's poses or the target's size limit the error")
    now, then = (
        float(x) for x in re.findall(r"about (\S+) mm instead of (\S+) mm", sentences[1])[0]
    )
    # Both are said to a tenth.
    assert now == pytest.approx(then / np.sqrt(2.0), abs=0.05 * (1.0 + 1.0 / np.sqrt(2.0)))
    assert "32 views of the same kind instead of 16" in sentences[1]
    assert "held-out errors" in sentences[2]


def test_an_exact_robot_leaves_the_camera_to_limit(data):
    exact = random_scene(2, VIEWS, POINTS).data
    fit = calibrate(exact, LENS, noise=Noise(pixel=0.15, translation=1e-7, rotation=1e-7))
    sentences = next_steps(fit, exact, error_summaries(fit, exact))
    assert sentences[0].startswith("The camera and the detected points limit the error")


def test_a_fit_that_failed_is_not_judged_by_its_numbers(fit, data):
    failed = dataclasses.replace(
        fit.joint, result=FitResult(FitCode.STOPPED_EARLY, "ran out of steps")
    )
    sentences = next_steps(type(fit).of(fit.staged, failed, data), data, error_summaries(fit, data))
    assert len(sentences) == 1
    assert "rejected views" in sentences[0]
