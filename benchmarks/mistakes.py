"""Deliberate mistakes in good data sets: does `smartview check` name each of them?

Each of 25 usual mistakes is made in real and simulated data sets, one at a time: in the poses, in
what the folder says of target and camera, or in the pictures' order and points. The changed data
are written as a folder, and `smartview check FOLDER --json` reads it. Printed is for each mistake
and set whether check

    named    says the mistake, in a problem or a doubt;
    seen     says something that it does not say of the set without the mistake;
    silent   says nothing more than without the mistake.

The last rows change nothing that matters (another base frame, another tool frame): there check
must say nothing more.

    python -m benchmarks mistakes
"""

import dataclasses
import json
import re
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import smartview_jax as sv
from smartview_jax.cli import app
from smartview_jax.dataset import Dataset
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.io import load_dataset, sample_folder
from smartview_jax.simulation import six_axis_scene

from .real_sets import SHARED, load

MIN_NAMED, MAX_SILENT = 0.95, 0.02
"""Claims: fractions of all mistakes in all sets that are named, and that nothing is said about."""

SMOKE_SETS = ("sample", "six_axis")

Poses = np.ndarray


class Mistake(NamedTuple):
    """One deliberate mistake.

    Attributes:
        name: what was done wrong.
        make: returns the data with the mistake.
        says: regular expression that a sentence naming the mistake matches; None where nothing is
            wrong.
    """

    name: str
    make: Callable[[Dataset], Dataset]
    says: str | None


def _with_poses(change: Callable[[Poses], Poses]) -> Callable[[Dataset], Dataset]:
    """Return a mistake in the robot's poses, `(views, 4, 4)`."""

    def make(data: Dataset) -> Dataset:
        poses = change(host_matrices(data.base_from_tool).copy())
        return dataclasses.replace(data, base_from_tool=as_se3(poses))

    return make


def _with_rotations(change: Callable[[Rotation], Rotation]) -> Callable[[Dataset], Dataset]:
    """Return a mistake in the reading of the robot's rotations."""

    def changed(poses: Poses) -> Poses:
        poses[:, :3, :3] = change(Rotation.from_matrix(poses[:, :3, :3])).as_matrix()
        return poses

    return _with_poses(changed)


def _scaled(factor: float) -> Callable[[Poses], Poses]:
    def changed(poses: Poses) -> Poses:
        poses[:, :3, 3] *= factor
        return poses

    return changed


def _typing_error(poses: Poses) -> Poses:
    """One digit of one coordinate."""
    poses[len(poses) // 3, 0, 3] += 0.1
    return poses


def _turned_view(poses: Poses) -> Poses:
    """One angle typed wrong by 10 degrees."""
    view = len(poses) // 3
    poses[view, :3, :3] = (
        Rotation.from_euler("z", 10.0, degrees=True).as_matrix() @ (poses[view, :3, :3])
    )
    return poses


def _swapped_rows(poses: Poses) -> Poses:
    first, second = len(poses) // 4, len(poses) // 2
    poses[[first, second]] = poses[[second, first]]
    return poses


def _off_by_one(poses: Poses) -> Poses:
    return np.roll(poses, 1, axis=0)


def _stale_rows(poses: Poses) -> Poses:
    """Every third pose was read before the robot had moved."""
    poses[2::3] = poses[1::3][: len(poses[2::3])]
    return poses


def _frozen(poses: Poses) -> Poses:
    return np.repeat(poses[:1], len(poses), axis=0)


def _other_tool(poses: Poses) -> Poses:
    """The controller's tool changed half-way."""
    tool = np.eye(4)
    tool[:3, 3] = 0.0, 0.0, 0.12
    half = len(poses) // 2
    poses[half:] = poses[half:] @ tool
    return poses


def _other_base(poses: Poses) -> Poses:
    """The controller's user frame changed half-way: turned and shifted."""
    half = len(poses) // 2
    poses[half:] = _some_frame() @ poses[half:]
    return poses


def _some_frame() -> np.ndarray:
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec([0.2, -0.3, 0.5]).as_matrix()
    frame[:3, 3] = 0.3, -0.2, 0.1
    return frame


def _moved_pixels(views: slice, shift: tuple[float, float], turn: float = 0.0) -> Any:
    """Return a mistake that moves the pixels of some views, as a bumped camera does."""

    def make(data: Dataset) -> Dataset:
        pixels = np.array(data.pixels)
        centre = 0.5 * np.array(data.image_size)
        cosine, sine = np.cos(turn), np.sin(turn)
        turned = (pixels[views] - centre) @ np.array([[cosine, sine], [-sine, cosine]]) + centre
        pixels[views] = turned + shift
        return dataclasses.replace(data, pixels=pixels)

    return make


def _bumped_camera(data: Dataset) -> Dataset:
    """Half-way the camera is knocked and turned by two degrees about its axis."""
    return _moved_pixels(slice(data.view_count // 2, None), (0.0, 0.0), np.deg2rad(2.0))(data)


def _mirrored(data: Dataset) -> Dataset:
    """All pictures are mirrored."""
    pixels = np.array(data.pixels)
    pixels[..., 0] = data.image_size[0] - 1.0 - pixels[..., 0]
    return dataclasses.replace(data, pixels=pixels)


def _from_other_end(data: Dataset) -> Dataset:
    """In one picture the target's points are counted from the other end."""
    view = data.view_count // 3
    pixels, visible = np.array(data.pixels), np.array(data.visible)
    pixels[view], visible[view] = pixels[view, ::-1], visible[view, ::-1]
    return dataclasses.replace(data, pixels=pixels, visible=visible)


def _repeated_picture(data: Dataset) -> Dataset:
    """One picture was copied to the next one's name."""
    view = data.view_count // 2
    pixels, visible = np.array(data.pixels), np.array(data.visible)
    pixels[view + 1], visible[view + 1] = pixels[view], visible[view]
    return dataclasses.replace(data, pixels=pixels, visible=visible)


def _zoomed(data: Dataset) -> Dataset:
    """The lens zoomed by 5 % half-way."""
    pixels = np.array(data.pixels)
    half, centre = data.view_count // 2, 0.5 * np.array(data.image_size)
    pixels[half:] = centre + 1.05 * (pixels[half:] - centre)
    return dataclasses.replace(data, pixels=pixels)


def _sized(factor: float) -> Callable[[Dataset], Dataset]:
    """Return a mistake in the stated spacing of the target."""

    def make(data: Dataset) -> Dataset:
        name = "spacing" if hasattr(data.target, "spacing") else "square"
        target = dataclasses.replace(
            data.target, **{name: factor * float(getattr(data.target, name))}
        )
        return dataclasses.replace(data, target=target, points=factor * np.array(data.points))

    return make


def _other_mount(data: Dataset) -> Dataset:
    mount = "eye_to_hand" if data.mount == "eye_in_hand" else "eye_in_hand"
    return dataclasses.replace(data, mount=mount)


def _read(written: str, read: str) -> Callable[[Rotation], Rotation]:
    """Return rotations whose angles were written in one order and read in another."""
    return lambda rotations: Rotation.from_euler(read, rotations.as_euler(written))


def _quaternion_read(rotations: Rotation) -> Rotation:
    """Written w x y z, read x y z w."""
    return Rotation.from_quat(rotations.as_quat()[:, [3, 0, 1, 2]])


def _degrees_as_radians(rotations: Rotation) -> Rotation:
    return Rotation.from_euler("xyz", rotations.as_euler("xyz", degrees=True))


def _vector_as_angles(rotations: Rotation) -> Rotation:
    """A rotation vector (Universal Robots) read as roll, pitch, yaw."""
    return Rotation.from_euler("xyz", rotations.as_rotvec())


MISTAKES = (
    Mistake("millimetres", _with_poses(_scaled(1000.0)), "millimet"),
    Mistake("inches as metres", _with_poses(_scaled(1 / 0.0254)), "inch"),
    Mistake("inverted poses", _with_poses(np.linalg.inv), "inver|tool_from_base"),
    Mistake("transposed rotations", _with_rotations(Rotation.inv), "transpos|inver"),
    Mistake("other mount", _other_mount, "eye_to_hand|eye_in_hand|mount"),
    Mistake("degrees as radians", _with_rotations(_degrees_as_radians), "degrees"),
    Mistake(
        "angles in another order", _with_rotations(_read("xyz", "zyx")), "order|read as|angles"
    ),
    Mistake(
        "fixed as moving axes", _with_rotations(_read("xyz", "XYZ")), "order|read as|angles|axes"
    ),
    Mistake("quaternion w first", _with_rotations(_quaternion_read), "quaternion"),
    Mistake("vector as angles", _with_rotations(_vector_as_angles), "vector"),
    Mistake("typing error of 0.1 m", _with_poses(_typing_error), "view {third}"),
    Mistake("one view turned 10 degrees", _with_poses(_turned_view), "view {third}"),
    Mistake(
        "swapped rows", _with_poses(_swapped_rows), "swap|exchang|view {quarter}.*|view {half}"
    ),
    Mistake(
        "rows off by one", _with_poses(_off_by_one), "fits the pose 1 view (after|before) its own"
    ),
    Mistake(
        "every third row stale", _with_poses(_stale_rows), "same pose|equal|repeat|not moved|stale"
    ),
    Mistake("one pose for all", _with_poses(_frozen), "same pose|equal|never move|not move|repeat"),
    Mistake("tool changed half-way", _with_poses(_other_tool), "from view {half} on"),
    Mistake("base changed half-way", _with_poses(_other_base), "from view {half} on"),
    Mistake("target twice as large", _sized(2.0), "target .*times as large|target's size"),
    Mistake("target 10 % too large", _sized(1.1), "target .*times as large|target's size"),
    Mistake("camera knocked half-way", _bumped_camera, "from view {half} on"),
    Mistake("lens zoomed half-way", _zoomed, "from view {half} on"),
    Mistake("mirrored pictures", _mirrored, "mirror|left-handed"),
    Mistake("points from the other end", _from_other_end, "view {third}"),
    Mistake("picture copied to the next", _repeated_picture, "view {half}|view {after_half}"),
    Mistake("another base frame", _with_poses(lambda poses: _some_frame() @ poses), None),
    Mistake("another tool frame", _with_poses(lambda poses: poses @ _some_frame()), None),
)
"""The mistakes, and two changes that are none."""


def run(smoke: bool = False) -> bool:
    """Print the table and what was said of unnamed mistakes; True where the claim holds."""
    sets = data_sets(SMOKE_SETS if smoke else None)
    print(f"{'':28}" + "".join(f"{name:>14}" for name in sets))
    before = {name: sentences(data) for name, data in sets.items()}
    verdicts, unnamed = [], []
    for mistake in MISTAKES:
        row = []
        for name, data in sets.items():
            said = sentences(mistake.make(data))
            verdict = _verdict(mistake, data, said, before[name])
            row.append(verdict)
            if verdict not in ("named", "right"):
                unnamed.append((mistake.name, name, verdict, said))
        print(f"{mistake.name:28}" + "".join(f"{verdict:>14}" for verdict in row), flush=True)
        verdicts += row
    for mistake_name, name, verdict, said in unnamed:
        print(f"\n{mistake_name}, {name}: {verdict}")
        for text in said:
            print(f"    {text[:300]}")
    named = sum(verdict in ("named", "right") for verdict in verdicts)
    print(f"\nnamed: {named} of {len(verdicts)}; silent: {verdicts.count('silent')}")
    few_silent = verdicts.count("silent") <= MAX_SILENT * len(verdicts)
    return named >= MIN_NAMED * len(verdicts) and few_silent and "FALSE" not in verdicts


def data_sets(names: tuple[str, ...] | None = None) -> dict[str, Dataset]:
    """Return the data sets by name; real ones as far as they lie next to the checkout."""
    chess = sv.targets.Chessboard
    sets: dict[str, Callable[[], Dataset]] = {
        "sample": lambda: load_dataset(sample_folder(), keep_detections=False),
        "six_axis": lambda: _described(six_axis_scene(3, 16).data, chess(9, 12, 0.03)),
    }
    for folder, prefix, target in (
        ("tampere_kuka_2", "", chess(17, 24, 0.015)),
        ("visp_franka_eih", "", chess(6, 9, 0.0236)),
        ("tampere_synthetic", "cs2_", chess(6, 9, 0.2)),
    ):
        if (SHARED / folder).is_dir():
            sets[folder.split("_")[1]] = partial(_real_set, folder, prefix, target)
    if (SHARED / "metric_workcell").is_dir():
        sets["workcell"] = _workcell
    return {name: load() for name, load in sets.items() if names is None or name in names}


def _described(data: Dataset, target: sv.targets.AbstractTarget) -> Dataset:
    """Return a data set with the description of its target, whose points its views see."""
    points = np.broadcast_to(np.asarray(target.points), data.points.shape)
    return dataclasses.replace(data, target=target, points=points)


def _real_set(folder: str, prefix: str, target: sv.targets.AbstractTarget) -> Dataset:
    """Return a real set from its tables."""
    return _described(load(folder, prefix)[0], target)


def _workcell() -> Dataset:
    """Return what a camera next to the arm saw of a board on the hand."""
    folder = SHARED / "metric_workcell"
    data = sv.io.import_correspondences(
        folder / "poses.csv", folder / "camera1_corners.csv", (1920, 1080), mount="eye_to_hand"
    )
    return _described(data.select(data.usable_views()), sv.targets.Chessboard(4, 3, 0.05))


def sentences(data: Dataset) -> list[str]:
    """Return the problems and doubts of `smartview check` on a folder of the data."""
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "data"
        _write(data, folder)
        result = CliRunner().invoke(app, ["check", str(folder), "--json"])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    if not result.stdout.startswith("{"):
        return [result.stderr.strip().splitlines()[-1]]
    document = json.loads(result.stdout)
    left_out = [f"view {view['view']}: {view['reason']}" for view in document["left_out_views"]]
    if "error" in document:
        return [str(document["error"])]
    return [*document["problems"], *document["doubts"], *left_out]


def _write(data: Dataset, folder: Path) -> None:
    """Write the folder as a person would: `sv.save_dataset` refuses some of the mistakes."""
    harmless = as_se3(np.broadcast_to(np.eye(4), (data.view_count, 4, 4)))
    sv.save_dataset(dataclasses.replace(data, base_from_tool=harmless), folder)
    header = (folder / "poses.csv").read_text().splitlines()[0]
    rows = [
        ",".join((view, *(repr(float(number)) for number in pose.ravel())))
        for view, pose in zip(data.view_ids, host_matrices(data.base_from_tool), strict=True)
    ]
    (folder / "poses.csv").write_text("\n".join((header, *rows)) + "\n")


def _verdict(mistake: Mistake, data: Dataset, said: list[str], before: list[str]) -> str:
    """Return how a mistake was answered."""
    new = [text for text in said if not any(_are_alike(text, other) for other in before)]
    if mistake.says is None:
        return "right" if not new else "FALSE"
    ids, count = data.view_ids, data.view_count
    places = {
        "third": ids[count // 3],
        "quarter": ids[count // 4],
        "half": ids[count // 2],
        "after_half": ids[count // 2 + 1],
    }
    wanted = mistake.says
    for place, view in places.items():
        wanted = wanted.replace("{" + place + "}", rf"{re.escape(view)}\b")
    if any(re.search(wanted, text) for text in new):
        return "named"
    return "seen" if new else "silent"


def _are_alike(first: str, second: str) -> bool:
    """Return whether two sentences differ in their numbers only, and by at most 3 %."""
    number = r"\d+(?:\.\d+)?"
    if re.sub(number, "#", first) != re.sub(number, "#", second):
        return False
    values, others = (np.array(re.findall(number, text), float) for text in (first, second))
    return np.allclose(values, others, rtol=0.03)
