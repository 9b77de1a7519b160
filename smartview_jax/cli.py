"""The `smartview` command."""

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

from .files import refuse_unwritable, written_together
from .interrupts import EXIT_CODE, WORDS, heard_at_once, told

if TYPE_CHECKING:
    import numpy as np

    from .calibration import Calibration
    from .dataset import Dataset
    from .evaluation import ErrorBudget, Repeatability, Unseen
    from .joint import CalibrationFit
    from .robots import SerialArm

app = typer.Typer(
    help="Calibrate cameras on robot arms.", no_args_is_help=True, pretty_exceptions_enable=False
)


class BadViews(StrEnum):
    """What to do about a view whose picture or pose is wrong."""

    RAISE = "raise"
    MASK = "mask"


class NoiseModel(StrEnum):
    """What the joint fit takes the robot's reported poses for."""

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
DebugOption = Annotated[bool, typer.Option("--debug", help="Show where an error came from.")]


def _version(asked: bool) -> bool:
    if asked:
        from . import __version__

        typer.echo(f"smartview_jax {__version__}")
        raise typer.Exit
    return asked


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
    with _errors(False):
        _keep_compiled()


def _keep_compiled() -> None:
    """JAX's persistent compilation cache: a second run starts several times faster."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    import jax

    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(home / "smartview_jax"))
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
    debug: DebugOption = False,
) -> None:
    """Calibrate: staged and joint fit, a table, calibration.yaml and report.html.

    Writes the staged pipeline's answer as calibration_staged.yaml besides; and, where the robot's
    error is corrected, calibration_uncorrected.yaml, for programs that cannot do that.
    """
    with _errors(debug):
        from .evaluation import without_rejected_views
        from .joint import calibrate as fit_both
        from .report import halves_agree, summaries, write_page

        refuse_unwritable(out, "--out")
        run = _run_name()
        notes: list[str] = []
        with _progress() as say:
            data, name = _load(dataset, bad_views, say)
            fit = fit_both(data, lens, noise=noise.value, progress=say)
            counted = without_rejected_views(data, fit)
            unseen = _held_out(counted, lens, noise, diagnose, say, notes) if held_out else {}
            halves = budget = None
            if diagnose:
                halves, budget = _diagnosis(fit, counted, lens, noise, say, notes)
        _print_result(summaries(fit, data, unseen), fit, data)
        for text in (*notes, *(f"even and odd views: {text}" for _, text in halves_agree(halves))):
            typer.echo(text)
        if budget is not None:
            _print_budget(budget)
        with _progress() as say, written_together(out, tuple(_RESULTS)) as folder:
            _save(fit, data, folder, run)
            title, page = f"Calibration of {name}", folder / "report.html"
            write_page(page, fit, data, unseen, title, say, halves, budget, notes, run)
        for file, words in _RESULTS.items():
            if (out / file).is_file():
                typer.echo(f"{out / file}: {words}")
        if not fit.result.converged:
            raise typer.Exit(1)


_RESULTS = {
    "calibration.yaml": "the calibration",
    "calibration_staged.yaml": "that of the staged pipeline",
    "calibration_uncorrected.yaml": "for programs that cannot correct the robot's error; predicts "
    "best without, but does not say where the camera sits",
    "report.html": "what was found, and how good it is",
}
"""Every file that `calibrate` writes, and what it is for."""


def _run_name() -> str:
    """Return a new name for a run, which all its files carry: the time, and what makes it one."""
    import secrets
    from datetime import UTC, datetime

    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}-{secrets.token_hex(3)}"


def _save(fit: "CalibrationFit", data: "Dataset", folder: Path, run: str) -> None:
    from .joint import best_uncorrected

    fit.calibration.save(folder / "calibration.yaml", run)
    fit.staged.calibration.save(folder / "calibration_staged.yaml", run)
    if fit.calibration.robot_error is not None:
        bare = best_uncorrected(data, fit)
        bare.save(folder / "calibration_uncorrected.yaml", run)


@app.command()
def compare(
    dataset: DatasetArgument = None,
    lens: LensOption = "opencv4",
    bad_views: BadViewsOption = BadViews.RAISE,
    debug: DebugOption = False,
) -> None:
    """Print staged, no-distortion, interpolation, one-view and joint fits side by side."""
    with _errors(debug):
        from .evaluation import Unseen, standard_methods
        from .evaluation import compare as compare_methods
        from .report import COMPARED, compared, remarks

        with _progress() as say:
            data, name = _load(dataset, bad_views, say)
            rows = compare_methods(data, standard_methods(lens), progress=say)
        table = Table(title=f"{name}, lens {lens}", box=box.SIMPLE_HEAD)
        for column in COMPARED:
            side = "left" if column == "method" else "right"
            # Names and spreads stay whole on a narrow terminal; the headings of the others wrap.
            table.add_column(column, justify=side, no_wrap=side == "left" or "+-" in column)
        for row in rows:
            table.add_row(*compared(row))
        console = Console()
        console.print(table)
        for row in rows:
            unseen = None if row.held_out is None else Unseen(row.held_out)
            for remark in remarks(row.name, row.fitted, unseen, row.failure):
                console.print(remark, highlight=False)


class ExportFormat(StrEnum):
    """What `export` writes."""

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
    """Print a calibration in another program's words."""
    with _errors(debug):
        from . import io
        from .calibration import Calibration

        found = Calibration.load(calibration)
        if found.robot_error is not None and to is not ExportFormat.CAMERA_INFO:
            typer.echo(
                "note: this calibration corrects the robot's error, and the other program will "
                "not; calibration_uncorrected.yaml predicts best without the correction",
                err=True,
            )
        if to is ExportFormat.ROS:
            frame = parent or ("tool0" if found.mount == "eye_in_hand" else "base_link")
            text = io.ros_static_transform(found, frame, child)
        elif to is ExportFormat.CAMERA_INFO:
            text = io.ros_camera_info(found)
        elif to is ExportFormat.URDF:
            text = io.urdf_origin(found)
        else:
            text = io.opencv_yaml(found)
        typer.echo(text, nl=False)


class SchemaOf(StrEnum):
    """Files that have a JSON schema."""

    DATASET = "dataset"
    CALIBRATION = "calibration"


@app.command()
def schema(of: Annotated[SchemaOf, typer.Argument(help="Of which file.")]) -> None:
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
    distance: Annotated[float, typer.Option(help="From the camera to the point, m.")] = 0.2,
    tilt: Annotated[float, typer.Option(help="From straight above, degrees.")] = 0.0,
    azimuth: Annotated[
        float, typer.Option(help="Where the camera stands, about z from x, degrees.")
    ] = 0.0,
    roll: Annotated[float, typer.Option(help="About the optical axis, degrees.")] = 0.0,
    five: Annotated[
        bool, typer.Option("--five", help="The paper's five viewpoints; tilt is their step.")
    ] = False,
    below: Annotated[
        bool, typer.Option("--below", help="The world's z points away from the camera.")
    ] = False,
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
    debug: DebugOption = False,
) -> None:
    """Print what to tell the robot so that the camera looks at a point, and write it for it."""
    with _errors(debug):
        import numpy as np

        from .calibration import Calibration
        from .io import write_viewpoints
        from .viewpoints import (
            FIVE_STEP,
            direction_of,
            five_viewpoints,
            look_at,
            viewpoint_commands,
        )

        if out is not None:
            refuse_unwritable(out.parent, "--out")
        known = Calibration.load(calibration)
        if not distance > 0.0:
            raise ValueError(f"--distance is in metres and positive; found {distance}")
        lean, around, turn = np.deg2rad([tilt, azimuth, roll])
        place, directions = np.array(at), direction_of(lean, np.array([around]), not below)
        if five:
            step = float(lean) or FIVE_STEP
            wanted = five_viewpoints(place, distance, float(turn), step, not below)
        else:
            wanted = look_at(place, directions, distance, float(turn))
        serial = _arm(arm, known)
        commands = viewpoint_commands(known, wanted, place[None], serial, _readings(near, serial))
        table = Table("view", "x mm", "y mm", "z mm", "O deg", "A deg", "T deg", "", box=box.SIMPLE)
        rows = np.asarray(commands.xyzoat) * np.repeat([1e3, 180.0 / np.pi], 3)
        for k, (row, reason) in enumerate(zip(rows, commands.checks.reasons(), strict=True)):
            table.add_row(f"v{1 + k}", *(f"{value:.3f}" for value in row), reason)
        Console().print(table)
        if serial is not None and commands.joints is not None:
            Console().print(_joint_table(np.asarray(commands.joints), serial))
        if out is not None:
            joints = None if commands.joints is None else np.asarray(commands.joints)
            write_viewpoints(out, commands.base_from_tool, joints=joints)
            typer.echo(out)


def _arm(words: str | None, known: "Calibration") -> "SerialArm | None":
    """The arm that is named, or whose own errors the calibration corrects."""
    from .io import load_urdf
    from .robots import arm_by_name, arm_of

    if words is not None:
        return load_urdf(words) if words.endswith(".urdf") else arm_by_name(words)
    return arm_of(known.field)


def _joint_table(joints: "np.ndarray", arm: "SerialArm") -> Table:
    import numpy as np

    units = ["mm" if slides else "deg" for slides in arm.prismatic]
    names = (f"q{1 + k} {unit}" for k, unit in enumerate(units))
    table = Table("view", *names, box=box.SIMPLE)
    for k, row in enumerate(joints * np.where(arm.prismatic, 1e3, 180.0 / np.pi)):
        table.add_row(f"v{1 + k}", *(f"{value:.3f}" for value in row))
    return table


def _readings(words: str | None, arm: "SerialArm | None") -> "np.ndarray | None":
    """Readings, rad and m, of degrees and metres between commas; None without an arm."""
    import numpy as np

    if arm is None:
        if words is not None:
            raise ValueError("--near: no arm to read; name one by --arm")
        return None
    if words is None:
        raise ValueError("an arm reaches a pose in several ways: say --near which readings")
    try:
        given = np.array([float(word) for word in words.split(",")])
    except ValueError:
        given = np.array([])
    if len(given) != arm.size or not np.isfinite(given).all():
        raise ValueError(f"--near: expected {arm.size} numbers between commas, found {words!r}")
    return np.where(arm.prismatic, given, np.deg2rad(given))


def _load(
    dataset: Path | None, bad_views: str, say: Callable[[str], None]
) -> "tuple[Dataset, str]":
    from .io import load_dataset, sample_folder

    if dataset is None:
        say("no data set given: the sample of the package")
        return load_dataset(sample_folder(), progress=say, keep_detections=False), "the sample"
    return load_dataset(dataset, bad_views, progress=say), dataset.resolve().name


def _held_out(
    data: "Dataset",
    lens: str,
    noise: NoiseModel,
    thorough: bool,
    say: Callable[[str], None],
    notes: list[str],
) -> "dict[str, Unseen]":
    """Held-out error of both fits, each fold fitted once; notes why there is none."""
    from .evaluation import unseen_errors
    from .joint import calibrate as fit_both

    if len(data.usable_views()) < 4:
        notes.append("held-out error needs at least 4 usable views: left out")
        return {}
    return unseen_errors(
        data,
        lambda part: fit_both(part, lens, noise=noise.value),
        thorough=thorough,
        progress=say,
    )


def _diagnosis(
    fit: "CalibrationFit",
    data: "Dataset",
    lens: str,
    noise: NoiseModel,
    say: Callable[[str], None],
    notes: list[str],
) -> "tuple[Repeatability | None, ErrorBudget | None]":
    """Whether halves of the views agree, and where the error comes from; notes what is not told."""
    from .evaluation import error_budget, repeatability
    from .joint import calibrate as fit_both

    def half(part: "Dataset"):
        say("half of the views")
        return fit_both(part, lens, noise=noise.value).joint

    halves = budget = None
    try:
        halves = repeatability(data, half)
    except ValueError as error:
        notes.append(f"halves of the views are not compared: {error}")
    try:
        budget = error_budget(data, fit.joint, say, regions=True)
    except ValueError as error:
        notes.append(f"there is no error budget: {error}")
    return halves, budget


def _print_budget(budget: "ErrorBudget") -> None:
    from .report import budget_rows, explanation_rows

    table = Table("cause", "RMS", title="where the error comes from", box=box.SIMPLE_HEAD)
    for name, px, _ in budget_rows(budget):
        table.add_row(name, px)
    console = Console()
    console.print(table)
    if budget.explanations:
        names = ("or one number", "its size", "gains", "beside the field", "unseen regions")
        table = Table(*names, box=box.SIMPLE_HEAD)
        for row in explanation_rows(budget):
            table.add_row(*row)
        console.print(table)
    console.print(budget.words, highlight=False)


def _print_result(rows, fit, data) -> None:
    from .report import rejections, remarks, table_rows, verdict

    table = Table()
    table.add_column("")
    for row in rows:
        table.add_column(row.name, justify="right")
    for texts in table_rows(rows):
        table.add_row(*texts)
    console = Console()
    console.print(table)
    console.print(verdict(rows, fit))
    for direction in fit.joint.observability.null:
        console.print(f"not determined: {direction.words}")
    for row in rows:
        for remark in remarks(row.name, row.fitted, row.unseen):
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
    """What is being done, on stderr: one changing line on a terminal, plain lines elsewhere."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: console.print(text, highlight=False, soft_wrap=True)
        return
    with console.status("starting") as status:
        yield lambda text: status.update(text)


@contextmanager
def _errors(debug: bool) -> Iterator[None]:
    """Errors a user can do something about, as one line; an interrupted run says so."""
    try:
        with heard_at_once():
            yield
    except KeyboardInterrupt:
        if not told.is_set():
            told.set()
            typer.echo(WORDS, err=True)
        sys.exit(EXIT_CODE)
    except (ValueError, OSError) as error:
        if debug:
            raise
        typer.echo(f"smartview: {error}", err=True)
        sys.exit(2)
