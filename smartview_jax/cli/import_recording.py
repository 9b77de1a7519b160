"""Define `smartview import`, which turns a recording into a data-set folder."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import typer

import smartview_jax as sv

from .options import DebugOption, parse_numbers, with_option_groups
from .terminal import errors_reported, print_lines, print_steps, progress_line


@dataclasses.dataclass(frozen=True)
class SourceOptions:
    """The options that name topics and frames of a bag, or features of LeRobot."""

    image: Annotated[
        str | None,
        typer.Option(
            help="Topic of the pictures, such as /camera/color/image_raw (LeRobot: their feature, "
            "such as observation.images.wrist); by default the only one. Of several cameras, with "
            "a name for each: left=/left/image_raw,right=/right/image_raw."
        ),
    ] = None
    camera_info: Annotated[
        str | None,
        typer.Option(
            help="Topic of the known camera, such as /camera/color/camera_info; by default the one "
            "next to the pictures. Of several cameras: left=/left/info,right=/right/info."
        ),
    ] = None
    base: Annotated[
        str | None,
        typer.Option(help="Frame of the robot's base in tf, such as base_link; with --tool."),
    ] = None
    tool: Annotated[
        str | None,
        typer.Option(help="Frame of the robot's tool in tf, such as tool0; with --base."),
    ] = None
    robot: Annotated[
        str | None,
        typer.Option(
            help="Topic of the tool's poses in the base frame, such as /tcp_pose, instead of tf."
        ),
    ] = None
    joints: Annotated[
        str | None,
        typer.Option(
            help="Topic of joint readings, such as /joint_states; needs --arm. Without frames and "
            "topic of poses, the arm's kinematics gives the robot's poses."
        ),
    ] = None
    joint_names: Annotated[
        str | None,
        typer.Option(
            help="Names of the arm's joints in its order, such as j1,j2,j3,j4,j5,j6; by default "
            "from the .urdf file."
        ),
    ] = None
    arm: Annotated[
        str | None,
        typer.Option(
            help="Arm of the joint readings: a name, such as puma_560, or a .urdf file (its links "
            "from --base to --tool)."
        ),
    ] = None
    tag: Annotated[
        str | None,
        typer.Option(
            help="Topic or tf frame of a tag, such as /tag_pose or tag_7: import its poses instead "
            "of pictures."
        ),
    ] = None
    tag_id: Annotated[
        int | None,
        typer.Option(help="The tag's number, such as 7, in messages with several tags."),
    ] = None
    camera_frame: Annotated[
        str | None,
        typer.Option(
            help="Frame of the camera, such as camera_optical_frame, for a tag in tf; by default "
            "the tag's parent frame."
        ),
    ] = None
    received: Annotated[
        bool,
        typer.Option(
            "--received", help="Use the times of recording, not the stamps of the messages."
        ),
    ] = False

    def sources(self) -> "sv.BagSources":
        """Return the topics and frames, with the arm read from its file."""
        arm, names = self.arm_and_names()
        named = {key: value for key, value in vars(self).items() if key != "camera_frame"}
        named |= {"arm": arm, "joint_names": names, "camera": self.camera_frame}
        named |= {"image": _topics("--image", self.image)}
        named |= {"camera_info": _topics("--camera-info", self.camera_info)}
        return sv.BagSources(**named)

    def arm_and_names(self) -> "tuple[sv.robots.SerialArm | None, tuple[str, ...]]":
        """Return the arm of the joint readings and the names of its joints."""
        if self.arm is None:
            return None, ()
        names = tuple(self.joint_names.split(",")) if self.joint_names is not None else ()
        if not self.arm.endswith(".urdf"):
            return sv.robots.arm_by_name(self.arm), names
        # The links of a robot's file have the names of its frames in tf.
        links = {"base": self.base, "tip": self.tool}
        return sv.io.load_urdf(self.arm, **links), names or sv.io.urdf_joint_names(
            self.arm, **links
        )


@dataclasses.dataclass(frozen=True)
class LeRobotOptions:
    """The options that a data set of LeRobot needs, as it states neither units nor poses."""

    angle_unit: Annotated[
        str | None,
        typer.Option(
            help="LeRobot: unit of the joint readings (such as deg): deg or rad. Readings in "
            "percent of a joint's range, which some arms record, cannot be used."
        ),
    ] = None
    pose_format: Annotated[
        str | None,
        typer.Option(
            help="LeRobot: the state has poses of the tool in this format, such as quaternion_xyzw "
            "or ur, instead of joint readings (--arm)."
        ),
    ] = None
    state_names: Annotated[
        str | None,
        typer.Option(
            help="LeRobot: names of the numbers of the state that are used, in the order of the "
            "arm's joints or of the pose format, such as x,y,z,qx,qy,qz,qw; by default all."
        ),
    ] = None
    episodes: Annotated[
        str | None,
        typer.Option(help="LeRobot: numbers of the episodes used, such as 0,3; by default all."),
    ] = None

    def sources(self, source: SourceOptions) -> "sv.LeRobotSources":
        """Return the features and the robot's state."""
        given = {f"--{name.replace('_', '-')}": getattr(source, name) for name in _OF_BAGS}
        if wrong := [name for name, value in given.items() if value]:
            raise ValueError(f"{wrong[0]}: not for a data set of LeRobot")
        arm, _ = source.arm_and_names()
        numbers = self.episodes.split(",") if self.episodes is not None else []
        if not all(number.strip().isdigit() for number in numbers):
            raise ValueError(f"--episodes: expected numbers such as 0,3; found {self.episodes}")
        return sv.LeRobotSources(
            image=_topics("--image", source.image),
            state=source.joints or source.robot or "observation.state",
            names=tuple(self.state_names.split(",")) if self.state_names is not None else (),
            arm=arm,
            angle_unit=self.angle_unit,
            pose_format=self.pose_format,
            episodes=tuple(map(int, numbers)),
        )


def _topics(option: str, text: str | None) -> str | dict[str, str] | None:
    """Return one topic, or the topics of several cameras by their names, as in left=/a,right=/b."""
    if text is None or "=" not in text:
        return text
    parts = [part.partition("=") for part in text.split(",")]
    topics = {name.strip(): topic.strip() for name, _, topic in parts}
    if len(topics) < len(parts) or not all(topics.values()):
        raise ValueError(
            f"{option}: expected a topic for each of the cameras, with different names, such as "
            f"left=/left/image_raw,right=/right/image_raw; found {text!r}"
        )
    return topics


_OF_BAGS = ("camera_info", "joint_names", "tag", "tag_id", "camera_frame", "received")
"""Options of `SourceOptions` that a data set of LeRobot does not have."""


@dataclasses.dataclass(frozen=True)
class MomentOptions:
    """The options that choose which pictures become views."""

    every: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Take every N-th picture, also in motion, such as 30 (a number); by default one "
            "of every stop of the robot.",
        ),
    ] = None
    still_for: Annotated[
        float,
        typer.Option(
            min=0.01,
            help="Shortest stop of the robot, a number of seconds such as 1; half of it has to "
            "pass before and after the picture.",
        ),
    ] = 0.5
    still_within: Annotated[
        str,
        typer.Option(
            help="Largest motion of a robot that stands, in mm and degrees, such as 0.5,0.2 for an "
            "arm with rough encoders."
        ),
    ] = "0.1,0.023"

    def choice(self) -> "sv.MomentChoice":
        """Return the rules, in the library's units."""
        millimetres, degrees = parse_numbers(
            "--still-within", self.still_within, 2, "mm and degrees"
        )
        return sv.MomentChoice(
            self.every, self.still_for, 1e-3 * millimetres, math.radians(degrees)
        )


@dataclasses.dataclass(frozen=True)
class TargetOptions:
    """The options that say what is in the pictures, and what the camera is mounted on."""

    target: Annotated[
        str | None,
        typer.Option(
            help="The target in the pictures: a file, such as another data set's dataset.yaml, or "
            "Kalibr's target.yaml; or chessboard, circle_grid, charuco, tag_grid or aprilgrid, "
            "whose lengths are then to be filled in."
        ),
    ] = None
    eye_to_hand: Annotated[
        bool, typer.Option("--eye-to-hand", help="Fixed camera; the target is on the tool.")
    ] = False

    @property
    def mount(self) -> str:
        """The mount of the camera, by its name in a data set."""
        return "eye_to_hand" if self.eye_to_hand else "eye_in_hand"


@with_option_groups
def import_(
    recording: Annotated[
        Path,
        typer.Argument(
            help="A .bag file of ROS 1, a folder or .db3 file of ROS 2, or .mcap; or a folder of "
            "LeRobot."
        ),
    ],
    folder: Annotated[Path, typer.Argument(help="Folder of the new data set.")],
    *,
    pictured: TargetOptions,
    source: SourceOptions,
    lerobot: LeRobotOptions,
    moments: MomentOptions,
    debug: DebugOption = False,
) -> None:
    """Turn a recording of ROS (a bag) or of LeRobot into a data set: pictures, robot poses.

    smartview import run.mcap my_folder --base base_link --tool tool0 --target charuco

    smartview import so101_data my_folder --arm so101.urdf --angle-unit deg --target charuco

    smartview import run.mcap my_folder --base base_link --tool tool0 --target charuco --image
    left=/left/image_raw,right=/right/image_raw

    One picture of every stop of the robot is taken, because there the clocks of camera and robot
    do not matter. Needs pip install 'smartview-jax[ros]', but no installation of ROS; or
    'smartview-jax[lerobot]'.
    """
    with errors_reported(debug):
        is_lerobot = (recording / sv.recordings.INFO_FILE).is_file()
        if not is_lerobot:
            # Before any option: whoever mistyped the recording has not begun to think of them.
            _refuse_other_recordings(recording)
        if pictured.target is None and source.tag is None:
            raise ValueError(
                "--target: expected the target in the pictures, such as charuco (or --tag for "
                "poses of a tag instead of pictures)"
            )
        target, mount = pictured.target, pictured.mount
        choice = moments.choice()
        with progress_line() as progress:
            if is_lerobot:
                if target is None:
                    raise ValueError("--tag: not for a data set of LeRobot; it needs --target")
                sources = lerobot.sources(source)
                written = sv.import_lerobot(
                    recording, folder, sources, target, mount, choice, progress
                )
            else:
                written = sv.import_bag(
                    recording, folder, source.sources(), target, mount, choice, progress
                )
        _print_summary(written)


def _refuse_other_recordings(path: Path) -> None:
    """Raise an error for a path that is no bag of ROS and no data set of LeRobot."""
    try:
        sv.recordings.bag_files(path)
    except ValueError as error:
        raise ValueError(
            f"{error}, or the folder of a data set of LeRobot, with {sv.recordings.INFO_FILE}"
        ) from error


def _print_summary(written: "sv.recordings.ImportedFolder") -> None:
    """Print what was used, what was left out and why, and the next steps."""
    print_lines(*written.notes)
    for reason, count in written.left_out.items():
        print_lines(f"left out: {count} ({reason})")
    print_lines(f"{written.folder}: {len(written.view_ids)} views; next steps:")
    steps = []
    if written.target_is_template:
        steps.append(
            f"measure the target and write its size into {written.folder / 'dataset.yaml'}: a 1 % "
            "error there makes a 1 % error in every distance"
        )
    # In motion a picture's pose depends on how late its stamp is.
    clock = " --time-offset" if written.in_motion else ""
    steps += [f"smartview check {written.folder}", f"smartview calibrate {written.folder}{clock}"]
    if written.camera_file is not None:
        steps[-1] += f" (or, with the camera held: --camera {written.camera_file})"
    print_steps(steps)
