"""Draw the frames and the steps of the method, after the paper's Figs. 4 and 5."""

import numpy as np
from matplotlib.axes import Axes

from ..calibration import Calibration, mount_frames
from ..dataset import Dataset
from ..geometry import host_matrices
from .figures import BLUE, GREEN, GREY, RED, PlotFigure, draw_frame, space_axes

AXIS_LENGTH = 0.12
"""Length of the axes of a frame over the extent of all frames."""


def frames_diagram(data: Dataset, calibration: Calibration, view: int = 0) -> PlotFigure:
    """Draw base, tool, camera and world frame of one view in their true places, as in Fig. 4.

    For a camera on one hand and a target on another, the other hand is in the place of the base.

    The links between them are the transforms of the chain: grey if the robot reports them, blue if
    they are calibrated.
    """
    eye_in_hand = mount_frames(calibration.mount)[0] == "tool"
    base = mount_frames(calibration.mount)[1] if eye_in_hand else "base"
    base_from_tool = host_matrices(calibration.with_bases(data.command).base_from_tool)[view]
    camera_from_world = np.asarray(calibration.camera_from_world_matrices(data.command))[view]
    holder_from_world = host_matrices(calibration.holder_from_world)
    # With a fixed camera the tool carries the target.
    base_from_world = holder_from_world if eye_in_hand else base_from_tool @ holder_from_world
    # All in the base's frame; the camera through the target, as the whole chain predicts it.
    base_from_frame = {
        base: np.eye(4),
        "tool": base_from_tool,
        "camera": base_from_world @ np.linalg.inv(camera_from_world),
        "world (target)": base_from_world,
    }
    mount, holder = calibration.transform_names
    links = [(base, "tool", f"{base}_from_tool", GREY)]
    links.append(("tool" if eye_in_hand else base, "camera", mount, BLUE))
    links.append((base if eye_in_hand else "tool", "world (target)", holder, BLUE))
    links.append(("camera", "world (target)", "camera_from_world", RED))
    figure = PlotFigure(figsize=(7.0, 5.6), layout="constrained")
    axes = space_axes(figure, "mm", f"x of the {base.replace('_', ' ')}")
    origins = {name: 1e3 * frame[:3, 3] for name, frame in base_from_frame.items()}
    length = AXIS_LENGTH * float(np.ptp(np.array(list(origins.values())), axis=0).max())
    for name, frame in base_from_frame.items():
        draw_frame(axes, frame, length, 1e3)
        x, y, z = map(float, origins[name])
        axes.text(x, y, z, f"  {name}", fontsize=10, weight="bold")
    for a, b, name, colour in links:
        axes.plot(*np.stack([origins[a], origins[b]]).T, "--", color=colour, linewidth=1)
        x, y, z = map(float, 0.5 * (origins[a] + origins[b]))
        axes.text(x, y, z, name, fontsize=8, color=colour)
    axes.set_aspect("equal")
    return figure


_STEPS = (
    ("pictures and robot poses", "circles, corners or tags; XYZOAT", GREY),
    ("Step 1: each view by itself", "camera and camera_from_world, after Weng", BLUE),
    ("Step 2: one camera for all views", "Kalman filter, outliers left out", BLUE),
    ("Step 3: the hand-eye transform", "A X = X B, by BFGS", BLUE),
    ("joint fit of everything at once", "and of the sizes of all errors", RED),
    ("calibration", "with its covariance and warnings", GREEN),
)
"""Title, explanation and colour of each step of a calibration."""


def steps_diagram() -> PlotFigure:
    """Draw the steps of a calibration, as in Fig. 5, and the joint fit that follows them."""
    figure = PlotFigure(figsize=(7.0, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set(xlim=(0.0, 1.0), ylim=(-len(_STEPS) + 0.4, 0.6))
    for k, (title, explanation, colour) in enumerate(_STEPS):
        _box(axes, -float(k), title, explanation, colour)
        if k + 1 < len(_STEPS):
            arrow = {"arrowstyle": "->", "color": GREY}
            axes.annotate("", (0.5, -k - 0.64), (0.5, -k - 0.36), arrowprops=arrow)
    return figure


def _box(axes: Axes, height: float, title: str, explanation: str, colour: str) -> None:
    """Draw a step: its title over its explanation, in a frame."""
    box = {"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": colour}
    axes.text(
        0.5, height, f"{title}\n{explanation}", ha="center", va="center", fontsize=10, bbox=box
    )
