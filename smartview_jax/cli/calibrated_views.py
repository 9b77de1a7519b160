"""Read the calibration of the views that a subcommand works on, of one camera or of a rig."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .load import NamedViews

if TYPE_CHECKING:
    from ..joint import SavedEstimate
    from ..modeling import AnyCalibration


@dataclass(frozen=True)
class RigOptions:
    """The options of a subcommand that may be given the calibration of a rig.

    Attributes:
        camera: the camera that took the views; None where the views say so.
        frame: frame of the results.
    """

    camera: Annotated[
        str | None,
        typer.Option(
            help="With a rig's calibration and pictures of one camera: its name, such as left.",
        ),
    ] = None
    frame: Annotated[
        str,
        typer.Option(
            help="With a rig's calibration: frame of the results, such as base (of the robot, for "
            "cameras on the hand and next to the arm) or world (of the target that all cameras "
            "saw).",
        ),
    ] = "world"


def load_calibrated_views(
    path: Path, views: NamedViews, wanted: RigOptions
) -> "tuple[AnyCalibration, SavedEstimate | None, bool]":
    """Return the calibration of views, its covariance, and whether it is taken as exact.

    Args:
        path: a calibration file, or the folder or file of a calibrated rig.
        views: the views.
        wanted: the camera that took them, and the frame of the results.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a wrong file, or a calibration that does not belong to the views.
    """
    from ..joint import is_rig, load_calibrated_rig, load_with_uncertainty
    from ..modeling import RigViews

    camera, frame = wanted.camera, wanted.frame
    if not is_rig(path):
        if views.cameras:
            raise ValueError(
                f"{path}: the views are of cameras {', '.join(dict.fromkeys(views.cameras))}: give "
                "the calibration of their rig, the folder that smartview calibrate wrote"
            )
        if camera is not None or frame != "world":
            raise ValueError(f"{path}: --camera and --frame are for the calibration of a rig")
        loaded, estimate = load_with_uncertainty(path)
        return loaded, estimate, estimate is None
    calibrations, joint = load_calibrated_rig(path)
    names = views.cameras
    if not names:
        if camera is None:
            raise ValueError(
                f"{path}: a rig of {', '.join(calibrations)}, and pictures of one camera: name it "
                "by --camera"
            )
        names = (camera,) * len(views.names)
    elif camera is not None:
        raise ValueError(f"--camera {camera}: the folder names the cameras of its pictures")
    states = views.states or None
    rig = calibrations if joint is None else joint
    return RigViews(rig, names, states, frame), None, joint is None
