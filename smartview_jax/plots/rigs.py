"""Draw the cameras of a rig where they are mounted, and where their uncertainty comes from."""

from collections.abc import Sequence

import numpy as np

from ..dataset import arms_of
from ..evaluation import PoseUncertainty
from ..geometry import host_matrices, host_transformed
from ..joint import RigFit
from .camera_scene import picture_corners
from .figures import PlotFigure, draw_frame, draw_pyramid, method_colour, space_axes

MOUNTS = {"eye_in_hand": "tool", "eye_to_hand": "base"}
"""Frame in which cameras of each mount stand still."""

PYRAMID_SHARE = 0.25
"""Depth of a drawn camera, over the largest distance between cameras and their mount's origin."""


def camera_mounts(fit: RigFit) -> PlotFigure:
    """Draw the frames of a rig's cameras where they are mounted: on the tool or next to the arm.

    Each camera is a pyramid that opens along its optical axis; the legend has the standard
    deviation of its position. The axes of frames are red (x), green (y) and blue (z).
    """
    frame_of = {name: _mount_frame(fit, name) for name in fit.calibrations}
    mounts = list(dict.fromkeys(frame_of.values()))
    figure = PlotFigure(figsize=(6.4 if len(mounts) == 1 else 4.8 * len(mounts), 4.6))
    # The automatic layouts cut the labels of axes in space.
    figure.subplots_adjust(0.03, 0.06, 0.93, 0.93)
    names = list(fit.calibrations)
    for column, mount in enumerate(mounts):
        cameras = {name: c for name, c in fit.calibrations.items() if frame_of[name] == mount}
        poses = {
            name: np.linalg.inv(host_matrices(calibration.camera_from_mount))
            for name, calibration in cameras.items()
        }
        places = np.array([np.zeros(3), *(pose[:3, 3] for pose in poses.values())])
        is_fixed = any(c.mount == "eye_to_hand" for c in cameras.values())
        unit, factor = ("m", 1.0) if is_fixed else ("mm", 1e3)
        axes = space_axes(figure, unit, place=(1, len(mounts), 1 + column))
        depth = PYRAMID_SHARE * max(float(np.ptp(places, axis=0).max()), 1e-2)
        draw_frame(axes, np.eye(4), factor * depth, factor)
        axes.text(0.0, 0.0, 0.0, f"{mount}  ", fontsize=9, ha="right", va="top")
        for name, calibration in cameras.items():
            colour = method_colour(name, names.index(name))
            mount_from_camera = poses[name]
            draw_frame(axes, mount_from_camera, 0.5 * factor * depth, factor)
            corners = depth * picture_corners(calibration.camera)
            corners = factor * host_transformed(mount_from_camera, corners)
            centre = factor * mount_from_camera[:3, 3]
            path = f"{name}.{calibration.transform_names[0]}.translation"
            stds = [fit.std[f"{path}.{k}"] for k in "xyz" if f"{path}.{k}" in fit.std]
            std = f"std {1e3 * np.hypot.reduce(stds):.2g} mm" if stds else "held"
            draw_pyramid(axes, centre, corners, colour, 1.2, f"{name}, {std}")
        # Before the lines of the axes, which cross it where there is little room.
        axes.legend(loc="upper left", facecolor="white", edgecolor="none", fontsize=9)
        axes.set_aspect("equal")
        axes.set_title(f"in the frame of the {mount}", fontsize=10)
        axes.tick_params(labelsize=7)
    return figure


def _mount_frame(fit: RigFit, camera: str) -> str:
    """Return the name of a camera's mount, with the name of the arm if there are several."""
    fixed = fit.calibrations[camera].mount == "eye_to_hand"
    frame = MOUNTS["eye_to_hand" if fixed else "eye_in_hand"]
    return f"{frame} of {arms_of(fit.arms[camera])[0]}" if fit.bases else frame


def pose_uncertainties(poses: Sequence[PoseUncertainty]) -> PlotFigure:
    """Draw which share of the variance of a rig's poses is due to each cause.

    The number after each bar is the standard deviation of the translation (mm) or the rotation
    (degrees), all axes together.

    Args:
        poses: the `poses` of a rig's `error_budget`.

    Raises:
        ValueError: no pose has any uncertainty.
    """
    poses = [pose for pose in poses if pose.causes and max(pose.translation, pose.rotation) > 0.0]
    if not poses:
        raise ValueError("poses: none has any uncertainty, so there is nothing to draw")
    causes = list(dict.fromkeys(cause.name for pose in poses for cause in pose.causes))
    figure = PlotFigure(figsize=(9.6, 1.3 + 0.42 * len(poses)), layout="constrained")
    parts = (("translation", 1e3, "mm"), ("rotation", np.rad2deg(1.0), "degrees"))
    all_axes = figure.subplots(1, 2, sharey=True)
    for axes, (part, factor, unit) in zip(all_axes, parts, strict=True):
        starts = np.zeros(len(poses))
        totals = np.array([getattr(pose, part) for pose in poses])
        for k, cause in enumerate(causes):
            squares = np.array(
                [
                    sum(getattr(entry, part) ** 2 for entry in pose.causes if entry.name == cause)
                    for pose in poses
                ]
            )
            shares = 100.0 * squares / np.where(totals > 0.0, totals, 1.0) ** 2
            # There are five colours, and more causes.
            axes.barh(
                np.arange(len(poses)),
                shares,
                0.7,
                starts,
                color=method_colour(cause, k),
                hatch="//" if k >= 5 else None,
            )
            starts += shares
        for row, total in enumerate(totals):
            axes.text(101.0, row, f"{factor * total:.2g} {unit}", va="center", fontsize=9)
        axes.set_xlim(0.0, 100.0)
        axes.set_xlabel(f"variance of the {part} (%)")
        axes.spines[["top", "right"]].set_visible(False)
    all_axes[0].set_yticks(np.arange(len(poses)), [pose.name for pose in poses])
    all_axes[0].invert_yaxis()
    figure.legend(
        [bars[0] for bars in all_axes[0].containers],  # pyright: ignore[reportIndexIssue]
        causes,
        loc="outside upper center",
        ncols=len(causes),
        frameon=False,
    )
    return figure
