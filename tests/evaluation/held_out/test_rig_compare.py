"""Methods compared on a rig, by fitters that know the answer, since real fits are tested alone."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax import Rig, compare, held_out
from smartview_jax.evaluation import (
    UNCORRECTED_SUFFIX,
    RigMethod,
    free_pose_errors,
    reprojection_errors,
    standard_rig_methods,
)
from smartview_jax.fit_result import FitCode, FitResult, Rejection
from smartview_jax.robot_errors import LinearInPosition, RobotError


@pytest.fixture(scope="module")
def rig(scene):
    views = scene.data.view_count
    return Rig({"left": scene.data, "right": scene.data.select(range(2, views))})


def test_a_rig_of_one_camera_has_the_rows_of_the_camera(scene):
    """Whether its fitter takes the camera or the rig."""
    bent = with_error(scene)

    def of_rig(part):
        return SimpleNamespace(calibrations=dict.fromkeys(part.cameras, bent))

    expected = compare(scene.data, {"method": lambda _: bent})
    methods = {"alone": RigMethod(lambda _: bent, alone=True), "together": of_rig}
    rows = compare(Rig({"only": scene.data}), methods)["only"]
    assert [row.name for row in rows] == [
        name for base in methods for name in (base, f"{base}, {UNCORRECTED_SUFFIX}")
    ]
    for row, same in zip(rows, [*expected, *expected], strict=True):
        np.testing.assert_array_equal(row.fitted.px, same.fitted.px)
        np.testing.assert_array_equal(row.held_out.errors.px, same.held_out.errors.px)
        assert list(map(set, row.held_out.folds)) == list(map(set, same.held_out.folds))


def with_error(scene):
    """The true calibration with a correction of the robot that makes it worse."""
    field = LinearInPosition.from_poses(scene.data.base_from_tool)
    error = RobotError(field, jnp.full(field.size, 1e-3))
    return dataclasses.replace(scene.calibration, robot_error=error)


def test_cameras_alone_and_together_are_fitted_without_the_same_states(scene, rig):
    shown = {"alone": [], "together": []}

    def one(data):
        shown["alone"].append(data)
        return scene.calibration

    def both(part):
        shown["together"].append(part)
        return SimpleNamespace(calibrations=dict.fromkeys(part.cameras, scene.calibration))

    said = []
    methods = {"alone": RigMethod(one, True), "together": both, "again": RigMethod(both)}
    rows = compare(rig, methods, 4, progress=said.append)
    assert len(shown["alone"]) == 2 * 5
    assert len(shown["together"]) == 5  # methods with one fitter share its fits
    assert "alone: right: fold 4 of 4" in said
    assert "together: fold 4 of 4" in said
    for number, (name, data) in enumerate(rig.cameras.items()):
        of_camera = shown["alone"][5 * number : 5 * (number + 1)]
        for seen, part in zip(of_camera, shown["together"], strict=True):
            np.testing.assert_array_equal(seen.visible, part.cameras[name].visible)
        alone, together, again = rows[name]
        assert again.held_out.errors.rms == together.held_out.errors.rms
        assert alone.held_out.folds == together.held_out.folds
        np.testing.assert_array_equal(
            together.held_out.errors.px, reprojection_errors(scene.calibration, data).px
        )


def test_what_a_rigs_fit_says_is_told_of_each_camera(scene, rig):
    entry = Rejection("3", 5, "far off")
    stopped = FitResult(FitCode.STOPPED_EARLY, "stopped early")

    def fitter(part):
        calibrations = dict.fromkeys(part.cameras, scene.calibration)
        return SimpleNamespace(
            calibrations=calibrations, rejected=(("right", entry),), result=stopped
        )

    rows = compare(rig, {"rig": fitter}, 4)
    assert rows["left"][0].rejected == ()
    assert rows["right"][0].rejected == (entry,)
    for found in (rows["left"][0].held_out, held_out(rig, fitter, 4)["right"]):
        assert found.unconverged_folds == tuple((k, "stopped early") for k in range(4))


def test_a_camera_that_cannot_be_fitted_alone_may_be_fitted_together(scene, rig):
    def alone(data):
        if data.view_count < scene.data.view_count:
            raise ValueError("too few views")
        return scene.calibration

    def fails(_):
        raise ValueError("cannot")

    rows = compare(rig, {"alone": RigMethod(alone, True), "together": fails})
    assert rows["left"][0].failure is None
    assert rows["right"][0].failure == "too few views"
    assert [rows[name][1].failure for name in rows] == ["cannot", "cannot"]


def test_the_standard_methods_fit_alone_and_together():
    methods = standard_rig_methods("pinhole")
    staged, joint, together, free = methods.values()
    assert staged.alone
    assert staged.fitter is joint.fitter
    assert together.fitter is free.fitter
    assert not together.alone
    assert free.measure is free_pose_errors
