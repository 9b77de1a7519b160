"""Define schemas for files of other programs; only the entries that are read are validated."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, TypeAdapter, model_validator

from .dataset import Codec
from .entry import Angle, Coordinate, Entry, Name, Plain, Said

Part = Annotated[float, Field(ge=-1.01, le=1.01), Said("a number of a unit quaternion")]
_Grid = Annotated[int, Field(ge=2, le=1000), Said("a whole number from 2 to 1000")]
_Spacing = Annotated[float, Field(gt=0.0, le=100.0), Said("a length in m, above 0 up to 100")]


class ForeignEntry(Entry):
    """A mapping written by another program, whose unknown entries are ignored."""

    model_config: ClassVar[Any] = Entry.model_config | {"extra": "ignore"}


class PoseParts(ForeignEntry):
    """A pose of robot_cal_tools: m, and a unit quaternion."""

    x: Coordinate
    y: Coordinate
    z: Coordinate
    qx: Part
    qy: Part
    qz: Part
    qw: Part


class CalDataEntry(ForeignEntry):
    """A view in a file of robot_cal_tools: the names of its pose file and its picture."""

    pose: Name
    image: Name


class TargetFinderEntry(ForeignEntry):
    """A circle grid of robot_cal_tools."""

    type: Name
    rows: _Grid
    cols: _Grid
    spacing: _Spacing


class TargetFile(ForeignEntry):
    """robot_cal_tools' target.yaml."""

    target_finder: TargetFinderEntry


class MeasuredEntry(ForeignEntry):
    """A measurement of robot_cal_tools' kinematic calibration; joints in rad."""

    camera_joints: list[Angle] | None = None
    target_joints: Annotated[list[Angle], Field(min_length=1, max_length=20)]
    pose: PoseParts


class Vector(ForeignEntry):
    """A translation of a ROS message, m."""

    x: Coordinate
    y: Coordinate
    z: Coordinate


class Quaternion(ForeignEntry):
    """A rotation of a ROS message."""

    x: Part
    y: Part
    z: Part
    w: Part


class TransformMessage(ForeignEntry):
    """A transform of a ROS message."""

    translation: Vector
    rotation: Quaternion


class SampleEntry(ForeignEntry):
    """A sample of easy_handeye: a pose of the robot and the pose of the tracked marker."""

    robot: TransformMessage
    tracking: TransformMessage


class SamplesFile(ForeignEntry):
    """A `.samples` file of easy_handeye."""

    samples: Annotated[list[SampleEntry], Field(min_length=1), Said("a list of one sample or more")]


class OpenCVMatrix(ForeignEntry):
    """A matrix of `cv2.FileStorage`."""

    rows: Annotated[int, Field(ge=1, le=1000), Said("a whole number from 1 to 1000")]
    cols: Annotated[int, Field(ge=1, le=1000), Said("a whole number from 1 to 1000")]
    data: Annotated[list[Plain], Field(max_length=10_000), Said("up to 10000 numbers")]


class OpenCVCameraFile(ForeignEntry):
    """A camera of `cv2.FileStorage`."""

    image_width: Annotated[int, Field(ge=1, le=100_000), Said("px: a whole number to 100000")]
    image_height: Annotated[int, Field(ge=1, le=100_000), Said("px: a whole number to 100000")]
    camera_matrix: OpenCVMatrix
    distortion_coefficients: OpenCVMatrix


class VispPoseFile(ForeignEntry):
    """ViSP's pose vector: m, and axis times angle in rad."""

    data: Annotated[
        list[
            Annotated[
                list[Coordinate], Field(min_length=1, max_length=1), Said("a list of one number")
            ]
            | Coordinate
        ],
        Field(min_length=6, max_length=6),
        Said("6 numbers: x, y, z in m, and axis times angle in rad"),
    ]


class VispCameraNumbers(ForeignEntry):
    """The model without distortion of a ViSP camera, px."""

    image_width: Annotated[int, Field(ge=1, le=100_000), Said("px: a whole number to 100000")]
    image_height: Annotated[int, Field(ge=1, le=100_000), Said("px: a whole number to 100000")]
    px: Annotated[float, Field(gt=0.0, le=1e7), Said("px, above 0 up to 1e7")]
    py: Annotated[float, Field(gt=0.0, le=1e7), Said("px, above 0 up to 1e7")]
    u0: Annotated[float, Field(ge=-1e6, le=1e6), Said("px, from -1e6 to 1e6")]
    v0: Annotated[float, Field(ge=-1e6, le=1e6), Said("px, from -1e6 to 1e6")]


class ViewpointEntry(Entry):
    """A command: a pose in a manufacturer's format, and joint readings in rad or m."""

    name: Name
    xyzoat: (
        Annotated[
            list[Plain],
            Field(min_length=6, max_length=6),
            Said("x, y, z in mm, O, A, T in degrees"),
        ]
        | None
    ) = None
    pose: (
        Annotated[
            list[Plain],
            Field(min_length=6, max_length=16),
            Said("the numbers that the file's format has, 6 to 16, in the file's units"),
        ]
        | None
    ) = None
    joints: Annotated[list[Angle], Field(min_length=1, max_length=20)] | None = None

    @model_validator(mode="after")
    def _is_one_pose(self) -> "ViewpointEntry":
        if (self.xyzoat is None) == (self.pose is None):
            raise ValueError("expected either xyzoat, of the format val_oat, or pose")
        return self


class ViewpointsFile(Entry):
    """A JSON file that `io.write_viewpoints` writes."""

    smartview_viewpoints: Literal[1]
    format: Codec = "val_oat"
    columns: Annotated[list[Name], Field(max_length=16)] | None = None
    units: dict[str, str]
    viewpoints: list[ViewpointEntry]


CAL_DATA = TypeAdapter(Annotated[list[CalDataEntry], Field(min_length=1)])
TARGET = TypeAdapter(TargetFile)
POSE = TypeAdapter(PoseParts)
MEASURED = TypeAdapter(dict[Name | int, MeasuredEntry])
SAMPLES = TypeAdapter(SamplesFile)
OPENCV_CAMERA = TypeAdapter(OpenCVCameraFile)
VISP_POSE = TypeAdapter(VispPoseFile)
VISP_CAMERA = TypeAdapter(VispCameraNumbers)
VIEWPOINTS = TypeAdapter(ViewpointsFile)
