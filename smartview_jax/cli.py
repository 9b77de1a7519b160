"""Define the `smartview` command and its subcommands."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from .files import file_transaction, refuse_unwritable
from .interrupts import INTERRUPT_EXIT_CODE, INTERRUPT_MESSAGE, interrupt_listener, message_printed

# The library is imported inside the commands: importing JAX takes seconds, which `--help` and a
# misspelt option should not cost.
if TYPE_CHECKING:
    import numpy as np
    from jaxlie import SE3

    from .calibration import Calibration
    from .calibration_pipeline import CalibrationFit
    from .dataset import Dataset
    from .evaluation import ErrorBudget, HeldOutReport, SplitHalfDifference
    from .geometry import PoseCodec
    from .report import ErrorSummary
    from .robots import SerialArm
    from .viewpoints import ViewpointCommands

app = typer.Typer(
    help="Calibrate cameras on robot arms.", no_args_is_help=True, pretty_exceptions_enable=False
)


class BadViews(StrEnum):
    """The treatments of a view whose picture or pose is invalid."""

    RAISE = "raise"
    MASK = "mask"


class NoiseModel(StrEnum):
    """The assumptions of the joint fit on errors of the robot's reported poses."""

    ESTIMATED = "estimated"
    TRUSTED = "trusted"


DatasetArgument = Annotated[
    Path | None, typer.Argument(help="Data-set folder; the sample of the package if not given.")
]
LensOption = Annotated[
    str, typer.Option(help="pinhole, radial, weng, opencv4, opencv5, opencv8 or fisheye.")
]
NoiseOption = Annotated[
    NoiseModel,
    typer.Option(help="Find the sizes of all errors, or take the robot's poses as exact."),
]
BadViewsOption = Annotated[
    BadViews, typer.Option(help="A view with wrong values: an error, or masked with its reason.")
]
BaseFromWorldOption = Annotated[
    str | None,
    typer.Option(
        help="Where the target stands, roughly, for a pattern that looks the same when turned: "
        "x,y,z in m and yaw,pitch,roll in degrees (tool_from_world if the camera stands)."
    ),
]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show where an error came from.")]


def _version(requested: bool) -> bool:
    """Print the version and exit, if that was requested."""
    if requested:
        from . import __version__

        typer.echo(f"smartview_jax {__version__}")
        raise typer.Exit
    return requested


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Calibrate cameras on robot arms.

    What is compiled is kept in ~/.cache/smartview_jax for the next run; JAX_COMPILATION_CACHE_DIR
    names another place, JAX_ENABLE_COMPILATION_CACHE=0 turns that off.
    """
    with _report_errors(False):
        _enable_compilation_cache()


def _enable_compilation_cache() -> None:
    """Enable JAX's persistent compilation cache, so that later runs start several times faster."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    import jax

    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(home / "smartview_jax"))
    # By default JAX keeps only what takes a second or more to compile.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.01)


@app.command()
def calibrate(
    dataset: DatasetArgument = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("calibration"),
    lens: LensOption = "opencv4",
    noise: NoiseOption = NoiseModel.ESTIMATED,
    held_out: Annotated[
        bool, typer.Option(help="Also refit without some views and predict those.")
    ] = True,
    diagnose: Annotated[
        bool, typer.Option(help="Also by region, halves of the views, and what causes the error.")
    ] = False,
    bad_views: BadViewsOption = BadViews.RAISE,
    base_from_world: BaseFromWorldOption = None,
    debug: DebugOption = False,
) -> None:
    """Calibrate: staged and joint fit, a table, calibration.yaml and report.html.

    Writes the staged pipeline's answer as calibration_staged.yaml besides; and, where the robot's
    error is corrected, calibration_uncorrected.yaml, for programs that cannot do that.
    """
    with _report_errors(debug):
        from .calibration_pipeline import calibrate as fit_both
        from .evaluation import without_rejected_views
        from .report import error_summaries, repeatability_rows, write_page

        # Checked first, so that minutes of fitting are not lost to a folder that is read-only.
        refuse_unwritable(out, "--out")
        run = _run_name()
        with _progress() as progress:
            data, name = _load(dataset, bad_views, progress, base_from_world)
            notes = list(data.notes)
            fit = fit_both(data, lens, noise=noise.value, progress=progress)
            warnings = fit.warnings
            # Views that the joint fit rejected are outliers, and say nothing about the calibration.
            inlier_data = without_rejected_views(data, fit)
            held_out_reports = (
                _held_out_reports(inlier_data, lens, noise, diagnose, progress, notes)
                if held_out
                else {}
            )
            split_half = budget = None
            if diagnose:
                split_half, budget = _diagnosis(fit, inlier_data, lens, noise, progress, notes)
                warnings += () if split_half is None else split_half.warnings
        notes += [f"warning: {text}" for text in warnings]
        _print_result(error_summaries(fit, data, held_out_reports), fit, data)
        for text in (
            *notes,
            *(f"even and odd views: {text}" for _, text in repeatability_rows(split_half)),
        ):
            typer.echo(text)
        if budget is not None:
            _print_budget(budget)
        with _progress() as progress, file_transaction(out, tuple(_RESULT_FILES)) as folder:
            # All files appear together, so that the report always belongs to the calibration.
            _save_calibrations(fit, data, folder, run, warnings)
            title, page_path = f"Calibration of {name}", folder / "report.html"
            write_page(
                page_path,
                fit,
                data,
                held_out_reports,
                title,
                progress,
                split_half,
                budget,
                notes,
                run,
            )
        for file, description in _RESULT_FILES.items():
            if (out / file).is_file():
                typer.echo(f"{out / file}: {description}")
        # The results are written nevertheless, but a script must notice a fit without convergence.
        if not fit.result.converged:
            raise typer.Exit(1)


_RESULT_FILES = {
    "calibration.yaml": "the calibration",
    "calibration_staged.yaml": "that of the staged pipeline",
    "calibration_uncorrected.yaml": "for programs that cannot correct the robot's error; predicts "
    "best without, but does not say where the camera sits",
    "report.html": "what was found, and how good it is",
}
"""Descriptions of the files that `calibrate` writes, by file name."""


def _run_name() -> str:
    """Return a unique name for a run, written to all its files: the time and a random part."""
    import secrets
    from datetime import UTC, datetime

    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}-{secrets.token_hex(3)}"


def _save_calibrations(
    fit: "CalibrationFit", data: "Dataset", folder: Path, run: str, warnings: tuple[str, ...]
) -> None:
    """Write the calibrations of a fit to a folder, by the names in `_RESULT_FILES`."""
    from .calibration_pipeline import refit_uncorrected

    fit.calibration.save(folder / "calibration.yaml", run, warnings)
    fit.staged.calibration.save(folder / "calibration_staged.yaml", run)
    if fit.calibration.robot_error is not None:
        uncorrected = refit_uncorrected(data, fit)
        uncorrected.save(folder / "calibration_uncorrected.yaml", run)


@app.command()
def compare(
    dataset: DatasetArgument = None,
    lens: LensOption = "opencv4",
    bad_views: BadViewsOption = BadViews.RAISE,
    base_from_world: BaseFromWorldOption = None,
    debug: DebugOption = False,
) -> None:
    """Print staged, no-distortion, interpolation, one-view and joint fits side by side."""
    with _report_errors(debug):
        from .evaluation import HeldOutReport, standard_methods
        from .evaluation import compare as compare_methods
        from .report import COMPARISON_HEADINGS, comparison_row, remarks

        with _progress() as progress:
            data, name = _load(dataset, bad_views, progress, base_from_world)
            rows = compare_methods(data, standard_methods(lens), progress=progress)
        table = Table(title=f"{name}, lens {lens}", box=box.SIMPLE_HEAD)
        for column in COMPARISON_HEADINGS:
            alignment = "left" if column == "method" else "right"
            # On a narrow terminal the headings wrap, but method names and "mean +- std" do not.
            table.add_column(
                column, justify=alignment, no_wrap=alignment == "left" or "+-" in column
            )
        for row in rows:
            table.add_row(*comparison_row(row))
        console = Console()
        console.print(table)
        for note in data.notes:
            console.print(note, highlight=False)
        for row in rows:
            held_out_report = None if row.held_out is None else HeldOutReport(row.held_out)
            for remark in remarks(row.name, row.fitted, held_out_report, row.failure):
                console.print(remark, highlight=False)


class ExportFormat(StrEnum):
    """The formats that `export` writes."""

    ROS = "ros"
    CAMERA_INFO = "camera_info"
    URDF = "urdf"
    OPENCV = "opencv"


@app.command()
def export(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    to: Annotated[ExportFormat, typer.Option(help="For which program.")],
    parent: Annotated[
        str | None,
        typer.Option(help="ROS frame of the mount; tool0, or base_link for a camera that stands."),
    ] = None,
    child: Annotated[str, typer.Option(help="ROS frame of the camera.")] = "camera_optical_frame",
    debug: DebugOption = False,
) -> None:
    """Print a calibration in another program's format."""
    with _report_errors(debug):
        from . import io
        from .calibration import Calibration

        # The note goes to stderr, because stdout may be redirected to the exported file.
        loaded_calibration = Calibration.load(calibration)
        if loaded_calibration.robot_error is not None and to is not ExportFormat.CAMERA_INFO:
            typer.echo(
                "note: this calibration corrects the robot's error, and the other program will "
                "not; calibration_uncorrected.yaml predicts best without the correction",
                err=True,
            )
        if to is ExportFormat.ROS:
            frame = parent or (
                "tool0" if loaded_calibration.mount == "eye_in_hand" else "base_link"
            )
            text = io.ros_static_transform(loaded_calibration, frame, child)
        elif to is ExportFormat.CAMERA_INFO:
            text = io.ros_camera_info(loaded_calibration)
        elif to is ExportFormat.URDF:
            text = io.urdf_origin(loaded_calibration)
        else:
            text = io.opencv_yaml(loaded_calibration)
        typer.echo(text, nl=False)


class SchemaName(StrEnum):
    """The files that have a JSON schema."""

    DATASET = "dataset"
    CALIBRATION = "calibration"


@app.command()
def schema(of: Annotated[SchemaName, typer.Argument(help="Of which file.")]) -> None:
    """Print the JSON schema of dataset.yaml or calibration.yaml, for editors.

    Editors with a YAML language server check a file that begins with the line
    `# yaml-language-server: $schema=dataset.schema.json`, where the schema was saved beside it.
    """
    from .schemas.json_schema import json_schema

    typer.echo(json_schema(of.value), nl=False)


@app.command()
def viewpoint(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    at: Annotated[
        tuple[float, float, float], typer.Option(help="Point to look at, in the world's frame, m.")
    ] = (0.0, 0.0, 0.0),
    distance: Annotated[
        float | None,
        typer.Option(help="From the camera to the point, m; by default that of the calibration."),
    ] = None,
    tilt: Annotated[float, typer.Option(help="From straight above, degrees.")] = 0.0,
    azimuth: Annotated[
        float, typer.Option(help="Where the camera stands, about z from x, degrees.")
    ] = 0.0,
    roll: Annotated[float, typer.Option(help="About the optical axis, degrees.")] = 0.0,
    five: Annotated[
        bool, typer.Option("--five", help="The paper's five viewpoints; tilt is their step.")
    ] = False,
    below: Annotated[
        bool | None,
        typer.Option(
            "--below/--above",
            help="The camera stands where the world's z is negative, or positive; by default on "
            "the side from which the calibration saw the target.",
        ),
    ] = None,
    arm: Annotated[
        str | None,
        typer.Option(help="Joint readings too: an arm's name (puma_560, ...) or a .urdf file."),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option(help="Readings to set out from, degrees (m where a joint slides): 0,-10,40."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Also write the commands: a .val, .csv or .json file.")
    ] = None,
    pose_format: Annotated[
        str,
        typer.Option(
            "--format",
            help="How the robot's maker writes poses: val_oat, kawasaki_oat, kuka_abc, ur, "
            "fanuc_wpr, abb, quaternion_xyzw, ...; .val files have VAL's.",
        ),
    ] = "val_oat",
    force: Annotated[
        bool,
        typer.Option("--force", help="Also what lies outside of what the calibration knows."),
    ] = False,
    debug: DebugOption = False,
) -> None:
    """Print commands by which the camera looks at a point, and write them for the robot.

    Refused, with nothing written, are commands out of reach, on the side of the target that was
    not seen, or far outside the views that the calibration was fitted to.
    """
    with _report_errors(debug):
        import numpy as np

        from .calibration import Calibration
        from .geometry import pose_codec
        from .io import write_viewpoints
        from .viewpoints import viewpoint_commands

        if out is not None:
            refuse_unwritable(out.parent, "--out")
        loaded_calibration, codec = Calibration.load(calibration), pose_codec(pose_format)
        point = np.array(at)
        camera_from_world = _requested_camera_poses(
            loaded_calibration, point, distance, (tilt, azimuth, roll), five, below
        )
        serial_arm = _arm_from_option(arm, loaded_calibration)
        commands = viewpoint_commands(
            loaded_calibration,
            camera_from_world,
            point[None],
            serial_arm,
            _parse_joint_readings(near, serial_arm),
        )
        # Printed before any refusal, which refers to the views by the names in the table.
        _print_viewpoints(commands, codec)
        joints = None if commands.joints is None else np.asarray(commands.joints)
        if serial_arm is not None and joints is not None:
            Console().print(_joint_table(joints, serial_arm))
        for text in _view_messages(commands.checks.reasons()):
            typer.echo(text)
        violations = _view_messages(commands.checks.safety_violations())
        if violations and not force:
            raise ValueError(
                f"refused, and nothing is written: {'; '.join(violations)}. --force if it is meant"
            )
        if out is not None:
            write_viewpoints(out, commands.base_from_tool, None, joints, pose_format)
            typer.echo(out)


DEFAULT_DISTANCE = 0.2
"""Default distance from the camera to the point, m, as in the paper.

It is used where a calibration has no region of viewpoints.
"""


def _requested_camera_poses(
    calibration: "Calibration",
    point: "np.ndarray",
    distance: float | None,
    angles_deg: tuple[float, float, float],
    five: bool,
    below: bool | None,
) -> "SE3":
    """Return the requested camera poses; distance and side default to those of the calibration."""
    import numpy as np

    from .viewpoints import FIVE_VIEWPOINT_STEP, five_viewpoints, look_at, viewing_direction

    region = calibration.region
    if distance is None:
        distance = (
            DEFAULT_DISTANCE
            if region is None
            else float(np.mean(np.asarray(region.distance_range)))
        )
    if not distance > 0.0:
        raise ValueError(f"--distance is in metres and positive; found {distance}")
    above = (None if region is None else region.above) if below is None else not below
    if above is None:
        raise ValueError(
            "the calibration does not say from which side the target was seen: --above if the "
            "world's z points to the camera, --below if away from it (as a chessboard's does)"
        )
    tilt, azimuth, roll = np.deg2rad(angles_deg)
    if five:
        return five_viewpoints(
            point, distance, float(roll), float(tilt) or FIVE_VIEWPOINT_STEP, above
        )
    directions = viewing_direction(tilt, np.array([azimuth]), above)
    return look_at(point, directions, distance, float(roll))


def _print_viewpoints(commands: "ViewpointCommands", codec: "PoseCodec") -> None:
    """Print the commanded poses in a manufacturer's format."""
    from .io import pose_columns

    table = Table("view", box=box.SIMPLE)
    for name in pose_columns(codec):
        table.add_column(name.replace("_", " "), justify="right", no_wrap=True)
    for k, row in enumerate(codec.encode(commands.base_from_tool, *codec.units)):
        table.add_row(
            f"v{1 + k}", *(_format_number(value, codec, n) for n, value in enumerate(row))
        )
    Console().print(table)


def _view_messages(texts: tuple[str, ...]) -> list[str]:
    """Return the texts that are not empty, each with its view's name as in the table."""
    return [f"v{1 + k}: {text}" for k, text in enumerate(texts) if text]


def _format_number(value: float, codec: "PoseCodec", column: int) -> str:
    """Return a number of a pose as text: three decimals for mm and degrees, else six."""
    millimetres = column in codec.length_columns and codec.units[0] == "mm"
    degrees = column in codec.angle_columns and codec.units[1] == "deg"
    return f"{value:.3f}" if millimetres or degrees else f"{value:.6f}"


def _arm_from_option(text: str | None, calibration: "Calibration") -> "SerialArm | None":
    """Return the named arm, or else the arm whose errors the calibration corrects, or None."""
    from .io import load_urdf
    from .robot_errors import nominal_arm
    from .robots import arm_by_name

    if text is not None:
        return load_urdf(text) if text.endswith(".urdf") else arm_by_name(text)
    return nominal_arm(calibration.field)


def _joint_table(joints: "np.ndarray", arm: "SerialArm") -> Table:
    """Return a table of joint readings, in degrees (mm for a prismatic joint)."""
    import numpy as np

    units = ["mm" if is_prismatic else "deg" for is_prismatic in arm.prismatic]
    names = (f"q{1 + k} {unit}" for k, unit in enumerate(units))
    table = Table("view", *names, box=box.SIMPLE)
    for k, row in enumerate(joints * np.where(arm.prismatic, 1e3, 180.0 / np.pi)):
        table.add_row(f"v{1 + k}", *(f"{value:.3f}" for value in row))
    return table


def _parse_joint_readings(text: str | None, arm: "SerialArm | None") -> "np.ndarray | None":
    """Return joint readings (rad, m) from text in degrees and metres; None without an arm."""
    import numpy as np

    if arm is None:
        if text is not None:
            raise ValueError("--near: no arm to read; name one by --arm")
        return None
    if text is None:
        # Inverse kinematics has several solutions; the one nearest to given readings is chosen.
        raise ValueError("an arm reaches a pose in several ways: say --near which readings")
    try:
        readings = np.array([float(word) for word in text.split(",")])
    except ValueError:
        readings = np.array([])
    if len(readings) != arm.joint_count or not np.isfinite(readings).all():
        raise ValueError(
            f"--near: expected {arm.joint_count} numbers between commas, found {text!r}"
        )
    return np.where(arm.prismatic, readings, np.deg2rad(readings))


def _load(
    dataset: Path | None,
    bad_views: str,
    progress: Callable[[str], None],
    base_from_world: str | None = None,
) -> "tuple[Dataset, str]":
    """Load a data set (the sample if none is named), and return it with its name."""
    from .io import load_dataset, parse_rough_pose, sample_folder

    rough_pose = None
    if base_from_world is not None:
        rough_pose = parse_rough_pose("--base-from-world", base_from_world)

    if dataset is None:
        # The sample belongs to the installed package, and nothing is written to its folder.
        progress("no data set given: the sample of the package")
        return load_dataset(sample_folder(), progress=progress, keep_detections=False), "the sample"
    data = load_dataset(dataset, bad_views, progress=progress, holder_from_world=rough_pose)
    return data, dataset.resolve().name


def _held_out_reports(
    data: "Dataset",
    lens: str,
    noise: NoiseModel,
    thorough: bool,
    progress: Callable[[str], None],
    notes: list[str],
) -> "dict[str, HeldOutReport]":
    """Return the held-out errors of both fits, refitting each fold once, or add a note why not."""
    from .calibration_pipeline import calibrate as fit_both
    from .evaluation import held_out_reports

    if len(data.usable_views()) < 4:
        notes.append("held-out error needs at least 4 usable views: left out")
        return {}
    return held_out_reports(
        data,
        lambda part: fit_both(part, lens, noise=noise.value),
        thorough=thorough,
        progress=progress,
    )


def _diagnosis(
    fit: "CalibrationFit",
    data: "Dataset",
    lens: str,
    noise: NoiseModel,
    progress: Callable[[str], None],
    notes: list[str],
) -> "tuple[SplitHalfDifference | None, ErrorBudget | None]":
    """Compare halves of the views and compute the error budget; note what cannot be computed."""
    from .calibration_pipeline import calibrate as fit_both
    from .evaluation import error_budget, split_half_difference

    def fit_half(half_data: "Dataset"):
        progress("half of the views")
        return fit_both(half_data, lens, noise=noise.value).joint

    # Each of the two may be impossible, such as with too few views, without harm to the other.
    split_half = budget = None
    try:
        split_half = split_half_difference(data, fit_half)
    except ValueError as error:
        notes.append(f"halves of the views are not compared: {error}")
    try:
        budget = error_budget(data, fit.joint, progress, held_out_by_region=True)
    except ValueError as error:
        notes.append(f"there is no error budget: {error}")
    return split_half, budget


def _print_budget(budget: "ErrorBudget") -> None:
    """Print the error budget, and the scale hypotheses if there are any."""
    from .report import budget_rows, scale_hypothesis_rows

    table = Table("cause", "RMS", title="where the error comes from", box=box.SIMPLE_HEAD)
    for name, px, _ in budget_rows(budget):
        table.add_row(name, px)
    console = Console()
    console.print(table)
    if budget.scale_hypotheses:
        names = ("or one number", "its size", "gains", "beside the field", "unseen regions")
        table = Table(*names, box=box.SIMPLE_HEAD)
        for row in scale_hypothesis_rows(budget):
            table.add_row(*row)
        console.print(table)
    console.print(budget.summary, highlight=False)


def _print_result(rows: "list[ErrorSummary]", fit: "CalibrationFit", data: "Dataset") -> None:
    """Print the table of errors, the summary, undetermined directions, remarks and rejections."""
    from .report import rejections, remarks, result_summary, table_rows

    table = Table()
    table.add_column("")
    for row in rows:
        table.add_column(row.name, justify="right")
    for texts in table_rows(rows):
        table.add_row(*texts)
    console = Console()
    console.print(table)
    console.print(result_summary(rows, fit))
    for direction in fit.joint.observability.null_directions:
        console.print(f"not determined: {direction.description}")
    for row in rows:
        for remark in remarks(row.name, row.registration_errors, row.held_out_report):
            console.print(remark, highlight=False)
    rejected = rejections(fit, data)
    if rejected:
        console.print("rejected:")
    for view, reason in rejected[:12]:
        console.print(f"  view {view}: {reason}", highlight=False)
    if len(rejected) > 12:
        console.print(f"  and {len(rejected) - 12} more, in the report")


@contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Report progress on stderr: one changing line on a terminal, plain lines elsewhere."""
    # On stderr, so that redirected results contain no progress.
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: console.print(text, highlight=False, soft_wrap=True)
        return
    with console.status("starting") as status:
        yield lambda text: status.update(text)


@contextmanager
def _report_errors(debug: bool) -> Iterator[None]:
    """Print an error that a user can correct as one line, and report an interrupt."""
    try:
        with interrupt_listener():
            yield
    except KeyboardInterrupt:
        if not message_printed.is_set():
            message_printed.set()
            typer.echo(INTERRUPT_MESSAGE, err=True)
        sys.exit(INTERRUPT_EXIT_CODE)
    except (ValueError, OSError) as error:
        if debug:
            raise
        typer.echo(f"smartview: {error}", err=True)
        sys.exit(2)
