"""Define the schema of `dataset.yaml`, which describes a data-set folder (`io.dataset_folder`)."""

import math
import re
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, TypeAdapter, model_validator

from .arm import ArmEntry, TransformEntry
from .calibration import CameraEntry, DepthSensorEntry, ImageSize
from .entry import Entry, Expected, PrintableText, Translation
from .target import PointsEntry, TargetEntry

END_MARK = "smartview_dataset"
"""Value of the last entry, `end`, by which a truncated file is recognised."""

MAX_POINTS = 1_000_000
"""Largest number of target points, over all heights, so that every view fits into memory."""

LengthUnit = Literal["m", "cm", "mm"]
AngleUnit = Literal["rad", "deg"]
CodecName = Literal[
    "matrix",
    "quaternion_xyzw",
    "quaternion_wxyz",
    "rotation_vector",
    "yaw_pitch_roll",
    "val_oat",
    "kawasaki_oat",
    "kuka_abc",
    "ur",
    "fanuc_wpr",
    "abb",
    "staubli_val3",
    "doosan",
    "comau",
    "xarm",
    "yaskawa",
    "denso",
    "techman",
    "mitsubishi",
    "epson",
    "euler_XYZ_fixed",
    "euler_XYZ_moving",
    "euler_XZY_fixed",
    "euler_XZY_moving",
    "euler_YXZ_fixed",
    "euler_YXZ_moving",
    "euler_YZX_fixed",
    "euler_YZX_moving",
    "euler_ZXY_fixed",
    "euler_ZXY_moving",
    "euler_ZYX_fixed",
    "euler_ZYX_moving",
    "euler_XYX_fixed",
    "euler_XYX_moving",
    "euler_XZX_fixed",
    "euler_XZX_moving",
    "euler_YXY_fixed",
    "euler_YXY_moving",
    "euler_YZY_fixed",
    "euler_YZY_moving",
    "euler_ZXZ_fixed",
    "euler_ZXZ_moving",
    "euler_ZYZ_fixed",
    "euler_ZYZ_moving",
]
_RowCount = Annotated[int, Field(ge=0, le=10**9), Expected("the file's number of rows")]


class CameraSizeEntry(Entry):
    """The pictures' size."""

    image_size: ImageSize


_Seconds = Annotated[float, Field(ge=-60.0, le=60.0), Expected("seconds, from -60 to 60")]


class PosesEntry(Entry):
    """A table of poses, one row per view: format, units and direction; none of them is guessed.

    Entries that the table's header states, as in a file of viewpoints, may be omitted. With
    `picture_times`, a table of times, the poses are the log of a moving robot; `time_offset` is
    added to the pictures' times to give times of the robot's clock.
    """

    file: PrintableText
    codec: CodecName | None = None
    length_unit: LengthUnit | None = None
    angle_unit: AngleUnit | None = None
    direction: Literal["base_from_tool", "tool_from_base"] | None = None
    rows: _RowCount | None = None
    picture_times: PrintableText | None = None
    time_offset: _Seconds | None = None

    @model_validator(mode="after")
    def _check_times(self) -> "PosesEntry":
        if self.time_offset is not None and self.picture_times is None:
            raise ValueError("time_offset: needs picture_times, the table of the pictures' times")
        return self


class CovariancesEntry(Entry):
    """A table of the covariances of tracked poses, one row per view."""

    file: PrintableText
    rows: _RowCount | None = None


class TrackedPosesEntry(Entry):
    """A table of the target's poses that a tracker measured, one row per view, without pictures.

    Entries that the table's header states may be omitted, but the direction is always stated. The
    depth sensor that measured the poses goes with their covariances.
    """

    file: PrintableText
    codec: CodecName | None = None
    length_unit: LengthUnit | None = None
    angle_unit: AngleUnit | None = None
    direction: Literal["camera_from_world", "world_from_camera"]
    rows: _RowCount | None = None
    covariances: CovariancesEntry | None = None
    depth_sensor: DepthSensorEntry | None = None
    camera: CameraEntry | None = None

    @model_validator(mode="after")
    def _check_sensor(self) -> "TrackedPosesEntry":
        if self.depth_sensor is not None and self.covariances is None:
            raise ValueError("depth_sensor: needs covariances, the table of the poses' covariances")
        return self


_Unit = Annotated[
    Annotated[LengthUnit, Tag("name")]
    | Annotated[
        Annotated[float, Field(gt=0.0, le=1.0), Expected("metres, above 0 up to 1")], Tag("metres")
    ],
    Discriminator(lambda unit: "name" if isinstance(unit, str) else "metres"),
]


class JointsEntry(Entry):
    """A table of joint readings, one row per view, and their arm: its name or its numbers."""

    file: PrintableText
    angle_unit: AngleUnit
    length_unit: LengthUnit
    arm: Annotated[
        Annotated[PrintableText, Tag("a name")] | Annotated[ArmEntry, Tag("numbers")],
        Discriminator(lambda arm: "numbers" if isinstance(arm, dict) else "a name"),
    ]
    rows: _RowCount | None = None


def check_pattern(text: str, required: Sequence[str] = ("view",)) -> str:
    """Return a pattern of picture names; raise a ValueError for a wrong placeholder.

    It must have the required placeholders, and may have `{height}` too.
    """
    # The pattern is passed to `str.format`, so other braces are refused.
    remainder = text.replace("{height}", "")
    for name in required:
        remainder = remainder.replace(f"{{{name}}}", "")
    complete = all(f"{{{name}}}" in text for name in required)
    if not complete or re.search("[{}]", remainder) or not remainder.isprintable():
        raise ValueError
    return text


_Pattern = Annotated[
    str,
    Field(max_length=200),
    AfterValidator(check_pattern),
    Expected("a name with {view}, and {height} if there are several heights, and no other braces"),
]


class PicturesEntry(Entry):
    """The pictures' file names, as one pattern."""

    pattern: _Pattern


class MeasuredPointsEntry(Entry):
    """Points of the target that a depth sensor measured, one file per view, and their unit."""

    pattern: _Pattern
    unit: _Unit


_DepthStd = Annotated[
    float, Field(ge=0.0, le=10.0), Expected("a standard deviation in m, from 0 to 10")
]


class DepthNoiseEntry(Entry):
    """Standard deviation of a depth z, and of the common error of a view's depths, m.

    A depth's own is the root of constant^2 + (quadratic z^2)^2.
    """

    constant: _DepthStd
    quadratic: _DepthStd = 0.0
    common: _DepthStd | None = None


class DepthPicturesEntry(Entry):
    """Depth pictures, one per view, their unit, and the file of the camera that took them.

    Without a camera its lens is to be found from pixels and depths together, and the depths may
    have a stated noise.
    """

    pattern: _Pattern
    unit: _Unit
    camera: PrintableText | None = None
    noise: DepthNoiseEntry | None = None

    @model_validator(mode="after")
    def _check_noise(self) -> "DepthPicturesEntry":
        if self.camera is not None and self.noise is not None:
            raise ValueError("noise: it is estimated where the camera is known; leave it out")
        return self


class DepthsEntry(Entry):
    """The table `depths.csv` of depths at the detected points, and their noise if it is known."""

    rows: _RowCount | None = None
    noise: DepthNoiseEntry | None = None


class DetectionsEntry(Entry):
    """The table `detections.csv` of detected points."""

    rows: _RowCount


_Degrees = Annotated[float, Field(ge=-3600.0, le=3600.0), Expected("degrees, from -3600 to 3600")]


class YawPitchRollPoseEntry(Entry):
    """A rough pose as a person writes it: metres and degrees."""

    translation: Translation
    yaw_pitch_roll_deg: Annotated[
        list[_Degrees],
        Field(min_length=3, max_length=3),
        Expected("yaw, pitch, roll in degrees: 3 numbers"),
    ]


RoughPose = Annotated[
    Annotated[YawPitchRollPoseEntry, Tag("angles")] | Annotated[TransformEntry, Tag("quaternion")],
    Discriminator(
        lambda pose: (
            "quaternion" if isinstance(pose, dict) and "quaternion_wxyz" in pose else "angles"
        )
    ),
]


def check_point_count(target: TargetEntry) -> None:
    """Raise a ValueError for a target with more than `MAX_POINTS` points."""
    if isinstance(target, PointsEntry):
        return
    # A grid has rows x columns, a ChArUco board squares_x x squares_y; absent sides count as 1.
    sides = [
        getattr(target, name, None) or 1 for name in ("rows", "columns", "squares_x", "squares_y")
    ]
    points = math.prod(sides) * len(target.heights or [0])
    if points > MAX_POINTS:
        raise ValueError(f"target: expected up to {MAX_POINTS} points, found {points}")


class DatasetFile(Entry):
    """A data-set folder's description.

    With `tracked_poses` there are no pictures, so that camera and target are not needed; with
    `measured_points` of a depth sensor there is a target, but no camera.
    """

    smartview_dataset: Literal[1]
    end_mark: Literal[True] | None = None
    camera: CameraSizeEntry | None = None
    target: TargetEntry | None = None
    tracked_poses: TrackedPosesEntry | None = None
    measured_points: MeasuredPointsEntry | None = None
    depth_pictures: DepthPicturesEntry | None = None
    depths: DepthsEntry | None = None
    mount: Literal["eye_in_hand", "eye_to_hand", "hand_to_hand"] = "eye_in_hand"
    poses: PosesEntry | None = None
    other_poses: PosesEntry | None = None
    joints: JointsEntry | None = None
    pictures: PicturesEntry | None = None
    detections: DetectionsEntry | None = None
    base_from_world: RoughPose | None = None
    tool_from_world: RoughPose | None = None
    end: Literal["smartview_dataset"] | None = None

    @model_validator(mode="after")
    def _check_consistency(self) -> "DatasetFile":
        if self.end_mark and self.end != END_MARK:
            raise ValueError(f"the last line, 'end: {END_MARK}', is missing: the file was cut")
        self._check_target()
        if self.poses is None and self.joints is None:
            raise ValueError("expected an entry 'poses', 'joints', or both")
        self._check_hands()
        if self.base_from_world is not None and self.mount == "eye_to_hand":
            raise ValueError("base_from_world: the target is on the tool: give tool_from_world")
        if self.tool_from_world is not None and self.mount == "eye_in_hand":
            raise ValueError("tool_from_world: the target is fixed: give base_from_world")
        return self

    def _check_hands(self) -> None:
        """Raise a ValueError for poses of a second arm without this mount, or the reverse."""
        if (self.mount == "hand_to_hand") != (self.other_poses is not None):
            raise ValueError(
                "other_poses: expected the poses of the arm that carries the target for mount "
                f"hand_to_hand, and only there; mount is {self.mount}"
            )
        if self.mount != "hand_to_hand":
            return
        for name in (
            "joints",
            "tracked_poses",
            "measured_points",
            "depth_pictures",
            "base_from_world",
            "tool_from_world",
        ):
            if getattr(self, name) is not None:
                raise ValueError(f"{name}: a data set with mount hand_to_hand has none")

    def _check_target(self) -> None:
        """Raise a ValueError without a target and a camera, or for a target of too many points."""
        forms = {
            "tracked_poses": (
                "camera",
                "target",
                "pictures",
                "detections",
                "measured_points",
                "depths",
            ),
            "measured_points": ("camera", "pictures", "detections", "depths"),
            "depth_pictures": ("detections", "tracked_poses", "measured_points", "depths"),
        }
        for form, foreign in forms.items():
            for name in foreign if getattr(self, form) is not None else ():
                if getattr(self, name) is not None:
                    raise ValueError(f"{name}: a data set of {form} has none")
        if self.tracked_poses is not None:
            return
        needed = ["target"] if self.measured_points is not None else ["camera", "target"]
        if self.depth_pictures is not None:
            needed.append("pictures")
        for name in needed:
            if getattr(self, name) is None:
                raise ValueError(f"entry '{name}' is missing")
        assert self.target is not None
        check_point_count(self.target)


DATASET_SCHEMA = TypeAdapter(DatasetFile)
