"""Small data sets are padded to few sizes: they share programs, and the answers stay the same."""

import dataclasses
import threading
import time

import jax
import numpy as np
import pytest
from fit_scenes import scene_of
from programs import programs_added
from starts import nudged

from smartview_jax import Noise, Prior, fit_joint
from smartview_jax.dataset import chain_residuals
from smartview_jax.robot_errors import LinearInPose
from smartview_jax.runtime.padding import (
    MAX_PADDED_OBSERVATIONS,
    in_batches,
    padded_counts,
    repeat_last,
    without_padding,
)
from smartview_jax.staged import calibrate_views, kalman_filter


def test_there_are_few_sizes_and_each_holds_what_is_padded():
    counts = [(views, points) for views in range(1, 33) for points in range(1, 129)]
    padded = np.array([padded_counts(*pair) for pair in counts])
    assert (padded >= counts).all()
    assert (padded.prod(axis=1) <= MAX_PADDED_OBSERVATIONS).all()
    # Fewer are added than there are, up to a size that takes no time.
    assert (padded < np.maximum(2 * np.array(counts), 17)).all()
    assert padded_counts(28, 408) == (28, 408)


def test_data_of_few_points_have_one_size_for_most_calibrations():
    assert {padded_counts(views, 12) for views in range(3, 17)} == {(16, 16)}
    assert {padded_counts(8, points) for points in range(1, 17)} == {(16, 16)}
    assert padded_counts(17, 12) == (32, 16)
    # Twice as many views of many points would take noticeably longer.
    assert padded_counts(5, 64) == (16, 64)
    assert padded_counts(5, 65) == (8, 128)


def test_what_is_added_repeats_the_last_entry_and_comes_off_again():
    arrays = {"a": np.arange(6.0).reshape(3, 2), "none": np.zeros((0, 2)), "flags": np.eye(3) > 0}
    padded = repeat_last(arrays, 5)
    np.testing.assert_array_equal(padded["a"], [[0, 1], [2, 3], [4, 5], [4, 5], [4, 5]])
    assert padded["none"].shape == (0, 2)
    # A JAX array for each would take longer than the program that they are padded for.
    assert isinstance(repeat_last(jax.device_put(arrays["a"]), 5), np.ndarray)
    assert padded["flags"].dtype == bool
    for name, array in without_padding(padded, 3).items():
        np.testing.assert_array_equal(array, arrays[name])
    np.testing.assert_array_equal(without_padding(arrays["a"], 2, 1), [[0.0], [2.0]])


def seen_in(views):
    scene = scene_of(2, views, translation_noise=1e-4, rotation_noise=1e-4)
    hidden = np.asarray(scene.data.visible).copy()
    hidden[1, ::3] = False
    return scene, scene.data.with_visible(hidden)


@pytest.fixture
def unpadded(monkeypatch):
    """Call it, and nothing is padded any more."""
    return lambda: monkeypatch.setattr("smartview_jax.runtime.padding.MAX_PADDED_OBSERVATIONS", 0)


def test_steps_1_and_2_find_the_same(unpadded):
    _, data = seen_in(9)
    found = []
    for _ in range(2):
        step1 = calibrate_views(data.observations, data.image_size)
        step2 = kalman_filter(
            data.observations, step1.camera(0, data.image_size), step1.camera_from_world
        )
        found.append((step1, step2))
        unpadded()
    (padded1, padded2), (plain1, plain2) = found
    assert padded1.starts == plain1.starts
    np.testing.assert_allclose(padded1.rms, plain1.rms, rtol=1e-6)
    np.testing.assert_array_equal(padded1.inliers, plain1.inliers)
    assert padded2.covariance.shape == (5 + 6 * 9,) * 2
    np.testing.assert_allclose(padded2.covariance, plain2.covariance, rtol=1e-5, atol=1e-18)
    np.testing.assert_allclose(
        padded2.camera_from_world.wxyz_xyz, plain2.camera_from_world.wxyz_xyz, atol=1e-7
    )


@pytest.mark.parametrize("kind", ["a robust loss", "a prior on the last view", "estimated"])
def test_a_joint_fit_finds_the_same(unpadded, kind):
    """The field of the second is the one that the third tries, so that both share programs."""
    scene, data = seen_in(9)
    last = f"pose_corrections.{data.view_ids[-1]}.translation"
    options = {
        "a robust loss": {"noise": "trusted", "loss": "cauchy"},
        "a prior on the last view": {
            "noise": Noise(0.15, 1e-4, 1e-4, (1e-4,) * 4),
            "field": LinearInPose.from_poses(data.base_from_tool),
            "priors": {last: Prior(std=1e-5, mean=2e-5)},
        },
        "estimated": {"noise": "estimated"},
    }[kind]
    fits = []
    for _ in range(2):
        fits.append(fit_joint(data, nudged(scene.calibration), **options))
        unpadded()
    padded, plain = fits
    for name in ("residuals", "pose_corrections", "covariance", "field_corrections"):
        found, expected = (np.asarray(getattr(fit, name)) for fit in fits)
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert padded.solution.costs[-1] == pytest.approx(plain.solution.costs[-1], rel=1e-9)
    np.testing.assert_allclose(list(padded.std.values()), list(plain.std.values()), rtol=1e-6)


def test_data_of_another_size_need_no_new_programs():
    """Five views and one point less; nor do they if the robot is trusted."""
    scene, data = seen_in(12)
    options = {"noise": Noise(0.15, 1e-4, 1e-4)}
    fit_joint(data, nudged(scene.calibration), **options)
    chain_residuals(scene.calibration, data.observations)
    fewer = data.select(range(7))
    fewer = dataclasses.replace(
        fewer, points=fewer.points[:, 1:], pixels=fewer.pixels[:, 1:], visible=fewer.visible[:, 1:]
    )
    with programs_added() as added:
        fit_joint(fewer, nudged(scene.calibration), **options)
        chain_residuals(scene.calibration, fewer.observations)
        fit_joint(fewer, nudged(scene.calibration), noise="trusted")
        assert not added
        # The check can fail: this is one.
        jax.jit(lambda x: x + 1.0)(0.0)
    assert added


@pytest.mark.parametrize("count", [0, 3, 4, 9])
def test_batches_give_every_row_its_result_by_one_program(count):
    rows, shapes = np.arange(2.0 * count).reshape(count, 2), set()

    def program(batch):
        shapes.add(batch.shape)
        return batch.sum(axis=1), 2.0 * batch

    sums, doubled = in_batches(program, rows, 4)
    np.testing.assert_array_equal(sums, rows.sum(axis=1))
    np.testing.assert_array_equal(doubled, 2.0 * rows)
    assert shapes == {(4, 2)}


def test_batches_that_run_side_by_side_keep_their_order():
    """Later ones are done first; the first is alone, because it compiles the program."""
    done = []

    def program(batch):
        time.sleep(0.02 if batch[0] == 2.0 else 0.0)
        done.append(int(batch[0]))
        return batch

    rows = np.arange(8.0)
    np.testing.assert_array_equal(in_batches(program, rows, 2, threads=3), rows)
    assert done[0] == 0
    assert done[-1] == 2


def test_one_thread_is_the_caller_s():
    """JAX's settings of a thread, such as the default device, hold for every batch."""
    threads = set()

    def program(batch):
        threads.add(threading.get_ident())
        return batch

    in_batches(program, np.arange(8.0), 2)
    assert threads == {threading.get_ident()}
