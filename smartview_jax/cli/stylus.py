"""Define `smartview stylus`, the paper's touch test (Fig. 2) on a real robot."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

import smartview_jax as sv

from ..files import read_yaml
from . import options
from .options import parse_numbers, with_option_groups
from .robot_commands import CommandSheet, RobotOptions, numbered_names
from .terminal import errors_reported, print_lines
from .viewpoint import LookOptions, requested_camera_poses


@dataclass(frozen=True)
class TouchOptions:
    """The options that say which points a stylus touches, and from where."""

    tip: Annotated[
        str,
        typer.Option(
            help="Tip of the stylus, x,y,z in m in the tool's frame, such as 0,0.01,0.15."
        ),
    ]
    at: Annotated[
        list[str] | None,
        typer.Option(
            help="Point to touch, x,y,z in m in the world's frame, such as 0.1,0,0.02; may be "
            "repeated.  [default: 0,0,0]"
        ),
    ] = None
    gap: Annotated[
        float,
        typer.Option(
            min=0.0, help="Distance to stop before the point, along the stylus, mm, such as 5."
        ),
    ] = 0.0
    tilt: Annotated[
        float, typer.Option(help="Tilt of the stylus from upright, degrees, such as 15.")
    ] = 0.0
    azimuth: Annotated[
        float, typer.Option(help="Direction of the tilt, about z from x, degrees, such as 90.")
    ] = 0.0
    turn: Annotated[float, typer.Option(help="Rotation about the stylus, degrees, such as 45.")] = (
        0.0
    )
    five: Annotated[
        bool, typer.Option("--five", help="Touch five times: upright, and tilted to four sides.")
    ] = False
    below: options.BelowOption = None

    def tip_position(self) -> np.ndarray:
        """Return the tip in the tool's frame, m."""
        return np.array(parse_numbers("--tip", self.tip, 3, "x,y,z (m)"))

    def points(self) -> list[np.ndarray]:
        """Return the points to touch in the world's frame, m."""
        texts = self.at or ["0,0,0"]
        return [np.array(parse_numbers("--at", text, 3, "x,y,z (m)")) for text in texts]


@dataclass(frozen=True)
class MissOptions:
    """The options of measured misses, and of a calibration that is corrected by them."""

    misses: Annotated[
        Path | None,
        typer.Option(
            help="File of measured misses in the world's axes, mm, such as misses.csv with the "
            "columns view,x_mm,y_mm,z_mm; or .yaml."
        ),
    ] = None
    corrected: Annotated[
        Path | None,
        typer.Option(
            help="Also write the calibration corrected by the misses, such as corrected.yaml."
        ),
    ] = None
    measurement_std: Annotated[
        float,
        typer.Option(
            min=1e-6,
            help="Standard deviation of each measured component of a miss, mm, such as 0.05.",
        ),
    ] = 0.1
    tip_std: Annotated[
        float,
        typer.Option(
            min=0.0, help="Standard deviation of each component of --tip, mm, such as 0.2."
        ),
    ] = 0.0


@with_option_groups
def stylus(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    *,
    touch: TouchOptions,
    missed: MissOptions,
    robot: RobotOptions,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Print the commands that put a stylus tip on a point of the target, and judge the misses.

    Touch, measure the vector from the point to the tip, and give these misses by --misses with
    otherwise the same options: they are compared with the errors that the calibration predicts.
    If they agree, --corrected writes the calibration that pictures and touches give together.
    """
    with errors_reported(debug):
        robot.refuse_unusable()
        tip_position, points = touch.tip_position(), touch.points()
        if missed.corrected is not None and missed.misses is None:
            raise ValueError("--corrected needs the measured misses: give --misses")
        loaded_calibration, estimate = sv.joint.load_with_uncertainty(calibration)
        arm, readings = robot.arm_and_readings(loaded_calibration)
        poses = np.concatenate(
            [_touching_poses(loaded_calibration, tip_position, point, touch) for point in points]
        )
        touches = sv.tool_commands(
            loaded_calibration,
            poses,
            estimate=estimate,
            arm=arm,
            near=readings,
        )
        names = numbered_names(len(poses))
        notes: list[str] = []
        measured = missed.misses and sv.io.read_misses(missed.misses, names, notes.append)
        factor = (
            sv.grasping.tip_error_factor(touches, tip_position)
            if measured is None
            else sv.grasping.measured_error_factor(
                touches, tip_position, 1e-3 * missed.measurement_std, 1e-3 * missed.tip_std
            )
        )
        sheet = CommandSheet(
            robot, loaded_calibration, names, touches.commands, arm, sv.grasping.TOOL_CHECKS
        )
        judged = _judgement(names, factor, measured) | {"notes": notes}
        if missed.corrected is not None:
            sheet.refuse_unsafe()
            if estimate is None or measured is None:
                raise ValueError(
                    f"{calibration} has no covariance, so that misses cannot correct it"
                )
            judged |= _write_corrected(
                calibration, estimate, touches, tip_position, measured, judged, missed
            )
        sheet.give(
            "stylus",
            json,
            lambda: _print_judgement(judged, calibration),
            **judged,
        )


def _touching_poses(
    calibration: "sv.Calibration",
    tip: np.ndarray,
    point: np.ndarray,
    touch: TouchOptions,
) -> np.ndarray:
    """Return `world_from_tool` with the tip at the gap before the point, `(n, 4, 4)`."""
    # The stylus points as a camera would look, so that the same options apply.
    look = LookOptions(1.0, touch.tilt, touch.azimuth, touch.turn, touch.five, touch.below)
    views = requested_camera_poses(calibration, point, look)
    world_from_stylus = sv.geometry.host_matrices(views).reshape(-1, 4, 4)[:, :3, :3].swapaxes(1, 2)
    rotations = sv.grasping.stylus_orientations(tip, world_from_stylus)
    points = point - 1e-3 * touch.gap * world_from_stylus[:, :, 2]
    # By NumPy: the tip's place by `touching_pose` would compile a program for each operation.
    return sv.geometry.host_poses(rotations, points - rotations @ tip)


def _write_corrected(
    path: Path,
    estimate: "sv.joint.SavedEstimate",
    touches: "sv.grasping.ToolCommands",
    tip: np.ndarray,
    misses: np.ndarray,
    judged: dict[str, Any],
    options: MissOptions,
) -> dict[str, Any]:
    """Write the calibration corrected by the misses; return its file and the miss it expects."""
    assert options.corrected is not None
    if judged["likely_causes"] is not None:
        raise ValueError(
            "the misses are larger than the calibration predicts (p "
            f"{judged['comparison']['p_value']:.2g}), so they do not correct it; find the cause: "
            f"{judged['likely_causes']}"
        )
    corrected = sv.correct_by_touches(
        estimate,
        touches,
        tip,
        misses,
        measurement_std=1e-3 * options.measurement_std,
        tip_std=1e-3 * options.tip_std,
    )
    # The fitted pictures and the doubts about them are still the first file's.
    first = read_yaml(path)
    corrected.save(
        options.corrected,
        source=f"{path.name}, corrected by {len(misses)} touches of a stylus",
        warnings=first.get("warnings") or (),
        pictures=first.get("pictures") or (),
    )
    touches = sv.tool_commands(corrected.calibration, touches.world_from_tool, estimate=corrected)
    factor = sv.grasping.tip_error_factor(touches, tip)
    assert factor is not None
    expected = sv.grasping.compare_misses(factor, misses).expected_rms
    return {"corrected": options.corrected, "corrected_expected_rms_m": expected}


def _judgement(
    names: tuple[str, ...], factor: np.ndarray | None, misses: np.ndarray | None
) -> dict[str, Any]:
    """Return the predicted and the measured miss of every touch, m, and their comparison."""
    size = 3 if misses is None else misses.shape[1]
    touches = []
    for k, name in enumerate(names):
        entry: dict[str, Any] = {"name": name, "expected": None}
        if factor is not None:
            part = factor[k, :size]
            axes, directions = sv.grasping.ellipse_axes(part @ part.T)
            # In the target's plane the direction of the longest axis is one angle.
            expected = {"std_m": np.sqrt(np.sum(part**2, axis=1)), "ellipse_half_axes_95_m": axes}
            entry["expected"] = expected | {"ellipse_directions": directions.T}
        if misses is not None:
            entry |= {"miss_m": misses[k], "distance_m": float(np.linalg.norm(misses[k]))}
        touches.append(entry)
    content: dict[str, Any] = {"touches": touches, "comparison": None, "likely_causes": None}
    if misses is not None:
        content["rms_m"] = float(np.sqrt(np.mean(np.sum(misses**2, axis=1))))
        if factor is not None:
            comparison = sv.grasping.compare_misses(factor, misses)
            # Every length in the document has its unit in its name.
            entries = comparison._asdict()
            entries["expected_rms_m"] = entries.pop("expected_rms")
            content["comparison"] = entries
            for entry, inside in zip(touches, comparison.inside, strict=True):
                entry["inside_ellipse"] = bool(inside)
            if comparison.p_value < sv.grasping.SURPRISING_P_VALUE:
                content["likely_causes"] = sv.grasping.causes_of_misses(factor, misses, names)
    return content


def _print_judgement(judged: dict[str, Any], path: Path) -> None:
    """Print the table of touches in mm, and the comparison in a sentence."""
    for note in judged["notes"]:
        print_lines(f"note: {note}")
    measured = "rms_m" in judged
    columns = ["touch", *(["miss (x, y, z) mm", "distance mm"] if measured else [])]
    table = Table(
        *columns, "its 95 % ellipse mm", *(["inside"] if measured else []), box=box.SIMPLE
    )
    for entry in judged["touches"]:
        expected = entry["expected"]
        ellipse = "not known" if expected is None else _semi(expected["ellipse_half_axes_95_m"])
        row = [entry["name"]]
        if measured:
            row += [_millimetres(entry["miss_m"]), f"{1e3 * entry['distance_m']:.2f}"]
        row.append(ellipse)
        if measured:
            row.append({None: "-", True: "yes", False: "no"}[entry.get("inside_ellipse")])
        table.add_row(*row)
    console = Console()
    console.print(table)
    if judged["touches"][0]["expected"] is None:
        print_lines(f"{path} has no covariance: the expected miss is not known")
    if not measured:
        return
    print_lines(f"{len(judged['touches'])} touches miss by {1e3 * judged['rms_m']:.2f} mm RMS")
    if judged["comparison"] is not None:
        print_lines(_verdict(judged["comparison"], judged["likely_causes"]))
    if "corrected" in judged:
        print_lines(
            f"{judged['corrected']}: corrected; it predicts "
            f"{1e3 * judged['corrected_expected_rms_m']:.2f} mm RMS for these touches"
        )


def _semi(half_axes: np.ndarray) -> str:
    """Return half axes of an ellipse as text, mm."""
    return " x ".join(f"{1e3 * axis:.2f}" for axis in half_axes)


def _millimetres(numbers: np.ndarray) -> str:
    """Return lengths as text, mm."""
    return sv.geometry.vector_text(1e3 * numbers, 2)


def _verdict(comparison: dict[str, Any], causes: str | None) -> str:
    """Return in words whether the misses are as large as the calibration predicts."""
    inside, expected = comparison["inside"], 1e3 * comparison["expected_rms_m"]
    # The touches share most of their error, so they are tested together.
    words = (
        "as the calibration predicts" if causes is None else "more than the calibration predicts"
    )
    return (
        f"predicted: {expected:.2f} mm RMS; {int(inside.sum())} of {len(inside)} are inside their "
        f"ellipse\nall together (chi-square {comparison['chi_square']:.1f}, "
        f"{comparison['degrees_of_freedom']} d.o.f., p {comparison['p_value']:.2g}): {words}"
        + ("" if causes is None else f"\n  likely causes: {causes}")
    )
