"""The names that other people's scripts call, with the arguments that they give by position."""

import inspect

import pytest

import smartview_jax as sv

CALLS = {
    "load_dataset": ("folder",),
    "Dataset.from_arrays": ("points", "pixels", "base_from_tool", "image_size"),
    "fit_staged": ("data", "lens"),
    "fit_joint": ("data", "start"),
    "calibrate": ("data",),
    "calibration_pipeline.CalibrationFit.report": ("self", "path"),
    "RigFit.report": ("self", "path"),
    "Noise": ("pixel", "translation", "rotation"),
    "Calibration.project": ("self", "base_from_tool", "points"),
    "Calibration.camera_from_world": ("self", "base_from_tool"),
    "Calibration.command_for": ("self", "camera_from_world"),
    "Calibration.save": ("self", "path"),
    "Calibration.load": ("path",),
    "JointFit.save": ("self", "path"),
    "xyzoat": ("base_from_tool",),
    "held_out": ("data", "fitter", "folds"),
    "cramer_rao": ("calibration", "data", "noise"),
    "ObjectModel": ("vertices", "edges", "faces"),
    "features.find": ("picture", "camera"),
    "modeling.epipolar_curve": ("calibration", "pose_a", "pixel", "pose_b", "depths"),
    "modeling.triangulate_points": ("calibration", "poses", "pixels", "visible"),
    "modeling.triangulate_lines": ("calibration", "poses", "segments", "visible"),
    "modeling.refine": ("start", "observations", "constraints"),
    "ModelSession": ("calibration", "poses"),
    "localize": ("pictures_or_features", "poses", "calibration", "models"),
    "next_view": ("localizations", "calibration", "reachable"),
    "grasps_for": ("localization", "gripper", "scene"),
    "Rig": ("cameras", "targets", "arms"),
    "RigFit.relative": ("self", "first", "second"),
    "fit_poses": ("samples",),
    "calibrate_many": ("datasets", "executor"),
    "fleet_prior": ("fits",),
}
"""The first arguments of each name, in their order."""


@pytest.mark.parametrize("name", CALLS)
def test_a_public_name_can_be_called(name):
    value = sv
    for part in name.split("."):
        value = getattr(value, part)
    assert tuple(inspect.signature(value).parameters)[: len(CALLS[name])] == CALLS[name]
