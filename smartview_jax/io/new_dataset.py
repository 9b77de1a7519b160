"""Begin a data-set folder: a description, commented or written by a program, and empty tables."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from .. import schemas
from ..argument_checks import require_one_of
from ..dataset import ONE_ARM, arms_of, is_pair
from ..detection import read_picture
from ..files import parse_yaml, refuse_existing, write_atomically
from ..geometry import PoseCodec, pose_codec
from ..targets import AbstractTarget, target_to_dict
from .csv_tables import write_table
from .folder_description import DESCRIPTION_FILE, FORMAT_VERSION
from .poses import POSES_FILE, poses_entry
from .table_text import VIEW_COLUMN
from .view_names import is_picture_name


class RobotFormat(NamedTuple):
    """The pose format of a robot manufacturer.

    Attributes:
        codec: name of the pose format, which includes its units.
        source: where the controller shows the numbers.
    """

    codec: str
    source: str


ROBOTS = {
    "abb": RobotFormat("abb", "the robtarget: pos and orient"),
    "comau": RobotFormat("comau", "the pendant: X Y Z A E R"),
    "denso": RobotFormat("denso", "CurPos: X Y Z RX RY RZ"),
    "doosan": RobotFormat("doosan", "get_current_posx(): x y z A B C"),
    "epson": RobotFormat("epson", "Here: X Y Z U V W"),
    "fanuc": RobotFormat("fanuc_wpr", "the position screen: X Y Z W P R"),
    "kawasaki": RobotFormat("kawasaki_oat", "the pendant: X Y Z O A T"),
    "kuka": RobotFormat("kuka_abc", "$POS_ACT: X Y Z A B C"),
    "mitsubishi": RobotFormat("mitsubishi", "P_Curr: X Y Z A B C"),
    "puma": RobotFormat("val_oat", "VAL's WHERE: X Y Z O A T"),
    "ros": RobotFormat("quaternion_xyzw", "tf2_echo base tool: translation, rotation"),
    "staubli": RobotFormat("staubli_val3", "here() in VAL 3: x y z rx ry rz"),
    "techman": RobotFormat("techman", "the pendant, robot base: X Y Z RX RY RZ"),
    "ur": RobotFormat("ur", "get_actual_tcp_pose(): x y z rx ry rz"),
    "xarm": RobotFormat("xarm", "get_position(): x y z roll pitch yaw"),
    "yaskawa": RobotFormat("yaskawa", "the current position: X Y Z Rx Ry Rz"),
    "matrix": RobotFormat("matrix", "4 x 4 matrices, row by row"),
}
"""Pose formats by the name of the manufacturer."""

TARGETS = {
    "chessboard": """target:
  kind: chessboard
  rows: 9            # inner corners, not squares
  columns: 6         # one of the two odd, the other even, so that the board has no symmetry
  square: 0.025      # MEASURE over many squares with a calliper, m""",
    "circle_grid": """target:
  kind: circle_grid
  rows: 10
  columns: 10
  spacing: 0.0254    # MEASURE from centre to centre over many circles, m
  origin_mark: true  # one circle is larger, so that the pattern cannot be taken upside down""",
    "charuco": """target:
  kind: charuco
  squares_x: 7
  squares_y: 5
  square: 0.03       # MEASURE over many squares, m
  marker: 0.022      # side of a marker, m
  dictionary: DICT_4X4_250
  legacy: false      # true for boards made before OpenCV 4.6 with an even number of rows""",
    "tag_grid": """target:
  kind: tag_grid
  rows: 4
  columns: 5
  size: 0.04         # MEASURE the black square's side, m
  gap: 0.01          # MEASURE the white between two black squares, m
  dictionary: DICT_APRILTAG_36h11
  first_id: 0
  border_bits: 1     # width of the black border in cells of the code
  rows_from: top     # or bottom: the row in which the numbers begin""",
    "aprilgrid": """target:
  kind: aprilgrid    # as Kalibr prints it; or, instead of the numbers:  file: target.yaml
  rows: 6            # tagRows
  columns: 6         # tagCols
  size: 0.088        # tagSize; MEASURE the black square's side, m
  spacing: 0.3       # tagSpacing: the gap in parts of that side""",
}
"""The entry `target` of every kind of target; comments mark what has to be measured."""


class FoundPictures(NamedTuple):
    """The pictures already in a folder.

    Attributes:
        image_size: width and height of the first picture, px.
        suffix: the most frequent suffix, with its dot.
        picture_count: number of pictures with that suffix.
        others: names of pictures with other suffixes.
    """

    image_size: tuple[int, int]
    suffix: str
    picture_count: int
    others: tuple[str, ...]


_DESCRIPTION = """# A data set for smartview: pictures of a target, and the robot's pose for each.
smartview_dataset: 1
{cameras}
{target}
# eye_in_hand: the camera is on the tool, the target stands still.
# eye_to_hand: the camera stands still, the target is on the tool.
mount: {mount}
# One row for each picture: its name, then {source}.
{poses}
# {{view}} stands for the name in the first column of {poses_file}.
pictures: {{pattern: "{pattern}"}}
"""

_POSES = """poses:
  file: {file}
  codec: {codec.name}
  length_unit: {length_unit}
  angle_unit: {angle_unit}
  direction: base_from_tool  # of the tool in the base frame; tool_from_base is the inverse"""


def new_pose_tables(arms: Mapping[str, str] | None) -> dict[str, str]:
    """Return each arm's table of poses in a new folder, by the arms of `write_new_dataset`."""
    names = dict.fromkeys(arm for entry in (arms or {}).values() for arm in arms_of(entry))
    tables = {arm: f"{arm}/{POSES_FILE}" for arm in names}
    return tables or {ONE_ARM: POSES_FILE}


def found_pictures(pictures: Path) -> FoundPictures | None:
    """Return the pictures in a folder, or None; an unreadable first one is a ValueError."""
    files = sorted(filter(is_picture_name, pictures.iterdir())) if pictures.is_dir() else []
    if not files:
        return None
    suffix, count = Counter(file.suffix for file in files).most_common(1)[0]
    first = next(file for file in files if file.suffix == suffix)
    rows, columns = read_picture(first).shape
    others = tuple(file.name for file in files if file.suffix != suffix)
    return FoundPictures((columns, rows), suffix, count, others)


def write_new_dataset(
    folder: Path,
    robot: str,
    target: str,
    mount: str,
    image_sizes: tuple[int, int] | Mapping[str, tuple[int, int]],
    suffix: str = ".png",
    arms: Mapping[str, str] | None = None,
) -> Path:
    """Write a commented `dataset.yaml`, the heading of `poses.csv` and the folder `images`.

    For several cameras there is a folder for each in `images`; for several arms, a folder for each
    with its table, such as `left/poses.csv`.

    Args:
        folder: the folder; it may exist, and may have pictures already.
        robot: one of `ROBOTS`.
        target: one of `TARGETS`.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        image_sizes: width and height of the pictures, px; of several cameras by their names.
        suffix: of the pictures' names, with its dot.
        arms: name of each camera's arm, by the camera's name: the arm that moves the camera or, if
            the camera stands next to it, the target; `left+right` for a camera on the hand of left
            that sees a target on the hand of right. None for one arm.

    Returns:
        The path of the description.

    Raises:
        ValueError: an unknown robot, target or mount, an invalid suffix, size or name, or several
            arms with cameras next to them, which see no target in common.
        FileExistsError: the folder has a description or a table already.
    """
    require_one_of("robot", robot, ROBOTS)
    require_one_of("target", target, TARGETS)
    require_one_of("mount", mount, ("eye_in_hand", "eye_to_hand"))
    for name, entry in (arms or {}).items():
        if len(set(arms_of(entry))) != len(arms_of(entry)) or len(arms_of(entry)) > 2:
            raise ValueError(
                f"arms: camera {name}: expected an arm, or two such as left+right, found {entry}"
            )
    if arms and mount == "eye_to_hand" and not any(map(is_pair, arms.values())):
        raise ValueError(
            "arms: cameras next to several arms see no target in common, which would tell where "
            "the arms are to each other; begin a data set for each arm"
        )
    tables = new_pose_tables(arms)
    description = folder / DESCRIPTION_FILE
    refuse_existing(folder, (DESCRIPTION_FILE, *tables.values()))
    codec = pose_codec(ROBOTS[robot].codec)
    cameras = image_sizes if isinstance(image_sizes, Mapping) else {}
    text = _DESCRIPTION.format(
        cameras=_cameras_text(image_sizes, arms or {}),
        target=TARGETS[target],
        mount=mount,
        source=ROBOTS[robot].source,
        poses=_arms_text(tables, codec) if arms else _poses_text(POSES_FILE, codec),
        poses_file=POSES_FILE,
        pattern=f"images/{'{camera}/' if cameras else ''}{{view}}{suffix}",
    )
    schema = schemas.RIG_SCHEMA if cameras else schemas.DATASET_SCHEMA
    schemas.refuse_unreadable(parse_yaml(text, description), schema, description)
    for camera in cameras or ("",):
        (folder / "images" / camera).mkdir(parents=True, exist_ok=True)
    for table in tables.values():
        (folder / table).parent.mkdir(exist_ok=True)
        write_atomically(folder / table, ",".join(("view", *codec.columns)) + "\n")
    # Written last, so that an interrupted run can be repeated.
    write_atomically(description, text)
    return description


def _cameras_text(
    image_sizes: tuple[int, int] | Mapping[str, tuple[int, int]], arms: Mapping[str, str]
) -> str:
    """Return the entry that describes one camera or several, each with its arm if there are any."""
    if not isinstance(image_sizes, Mapping):
        width, height = image_sizes
        size = f"{{image_size: [{width}, {height}]}}"
        return f"camera: {size}  # width and height of the pictures, px"
    rows = []
    for name, (width, height) in image_sizes.items():
        arm = ""
        if arms:
            first, *other = arms_of(arms[name])
            pair = f", mount: hand_to_hand, arm: {first}, target_arm: {other[0]}" if other else ""
            arm = pair or f", arm: {first}"
        rows.append(f"  {name}: {{image_size: [{width}, {height}]{arm}}}")
    return "\n".join(
        [
            "# {camera} below stands for a name here; width and height of its pictures, px.",
            "# A camera may have a mount of its own; see the example for several targets in",
            "# smartview_jax.io.rig_folder.",
            *(
                ["# arm: the arm that moves the camera, or its target if it is fixed."]
                if arms
                else []
            ),
            *(
                ["# hand_to_hand: the camera is on the hand of arm, its target on target_arm's."]
                if any(map(is_pair, arms.values()))
                else []
            ),
            "cameras:",
            *rows,
        ]
    )


def _poses_text(file: str, codec: PoseCodec) -> str:
    """Return the entry that describes the table of poses of an arm."""
    length_unit, angle_unit = codec.units
    return _POSES.format(file=file, codec=codec, length_unit=length_unit, angle_unit=angle_unit)


def _arms_text(tables: Mapping[str, str], codec: PoseCodec) -> str:
    """Return the entry that describes several arms, each with its table of poses."""
    rows = [
        "# Poses of each arm in its own base. Where the bases are is told by one target that",
        "# cameras on several hands see, or by a camera on one hand that sees a target on another.",
        "# An arm may have a codec of its own.",
        "arms:",
    ]
    for arm, table in tables.items():
        rows.append(f"  {arm}:")
        rows += [f"    {line}" for line in _poses_text(table, codec).splitlines()]
    return "\n".join(rows)


def write_description(
    folder: Path,
    target: AbstractTarget,
    mount: str,
    image_size: tuple[int, int],
    pose_format: str = "matrix",
    suffix: str = ".png",
) -> None:
    """Write `dataset.yaml` and a table of poses without rows, to be filled by `GrowingDataset`.

    Args:
        folder: folder to create.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        image_size: width and height of the pictures, px.
        pose_format: one of `POSE_CODECS`.
        suffix: of the pictures' names, with its full stop.

    Raises:
        ValueError: an unknown format or mount, or a target that could not be read back.
        FileExistsError: the folder has a description or a table already.
    """
    codec = pose_codec(pose_format)
    description, table = folder / DESCRIPTION_FILE, folder / POSES_FILE
    refuse_existing(folder, (DESCRIPTION_FILE, POSES_FILE))
    content = {
        "smartview_dataset": FORMAT_VERSION,
        "camera": {"image_size": [int(size) for size in image_size]},
        "target": target_to_dict(target),
        "mount": mount,
        "poses": poses_entry(None, pose_format),
        "pictures": {"pattern": f"images/{{view}}{suffix}"},
    }
    schemas.refuse_unreadable(content, schemas.DATASET_SCHEMA, description)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    write_table(table, (VIEW_COLUMN, *codec.columns), [])
    # Written last, so that an interrupted run can be repeated.
    schemas.write_validated(description, content, schemas.DATASET_SCHEMA)
