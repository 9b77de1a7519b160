"""Define schemas for files of other programs; only the entries that are read are validated."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, TypeAdapter, model_validator

from .calibration import ImageSize
from .dataset import CodecName
from .entry import (
    Angle,
    Coordinate,
    Entry,
    Expected,
    FiniteNumber,
    FocalLength,
    Name,
    PrintableText,
    check_pixel_shape,
)

QuaternionComponent = Annotated[
    float, Field(ge=-1.01, le=1.01), Expected("a number of a unit quaternion")
]
_GridCount = Annotated[int, Field(ge=2, le=1000), Expected("a whole number from 2 to 1000")]
_TagCount = Annotated[int, Field(ge=1, le=1000), Expected("a whole number from 1 to 1000")]
_Spacing = Annotated[float, Field(gt=0.0, le=100.0), Expected("a length in m, above 0 up to 100")]


class ForeignEntry(Entry):
    """A mapping written by another program, whose unknown entries are ignored."""

    model_config: ClassVar[Any] = Entry.model_config | {"extra": "ignore"}


class KalibrTargetFile(ForeignEntry):
    """Kalibr's `target.yaml` for an AprilGrid."""

    tagCols: _TagCount
    tagRows: _TagCount
    tagSize: _Spacing
    tagSpacing: Annotated[
        float, Field(gt=0.0, lt=1.0), Expected("the gap relative to a tag's side, 0 to 1")
    ]


class QuaternionPoseEntry(ForeignEntry):
    """A pose of robot_cal_tools: m, and a unit quaternion."""

    x: Coordinate
    y: Coordinate
    z: Coordinate
    qx: QuaternionComponent
    qy: QuaternionComponent
    qz: QuaternionComponent
    qw: QuaternionComponent


class CalDataEntry(ForeignEntry):
    """A view in a file of robot_cal_tools: the names of its pose file and its picture."""

    pose: PrintableText
    image: PrintableText


class TargetFinderEntry(ForeignEntry):
    """A circle grid of robot_cal_tools."""

    type: PrintableText
    rows: _GridCount
    cols: _GridCount
    spacing: _Spacing


class TargetFile(ForeignEntry):
    """A `target.yaml` of robot_cal_tools."""

    target_finder: TargetFinderEntry


class KinematicMeasurementEntry(ForeignEntry):
    """A measurement of robot_cal_tools' kinematic calibration; joints in rad."""

    camera_joints: list[Angle] | None = None
    target_joints: Annotated[list[Angle], Field(min_length=1, max_length=20)]
    pose: QuaternionPoseEntry


class TranslationMessage(ForeignEntry):
    """A translation of a ROS message, m."""

    x: Coordinate
    y: Coordinate
    z: Coordinate


class RotationMessage(ForeignEntry):
    """A rotation of a ROS message."""

    x: QuaternionComponent
    y: QuaternionComponent
    z: QuaternionComponent
    w: QuaternionComponent


class TransformMessage(ForeignEntry):
    """A transform of a ROS message."""

    translation: TranslationMessage
    rotation: RotationMessage


class SampleEntry(ForeignEntry):
    """A sample of easy_handeye: a pose of the robot and the pose of the tracked marker."""

    robot: TransformMessage
    tracking: TransformMessage


class SamplesFile(ForeignEntry):
    """A `.samples` file of easy_handeye."""

    samples: Annotated[
        list[SampleEntry], Field(min_length=1), Expected("a list of one sample or more")
    ]


class OpenCVMatrix(ForeignEntry):
    """A matrix of `cv2.FileStorage`."""

    rows: Annotated[int, Field(ge=1, le=1000), Expected("a whole number from 1 to 1000")]
    cols: Annotated[int, Field(ge=1, le=1000), Expected("a whole number from 1 to 1000")]
    data: Annotated[list[FiniteNumber], Field(max_length=10_000), Expected("up to 10000 numbers")]


class OpenCVCameraFile(ForeignEntry):
    """A camera of `cv2.FileStorage`, or of ROS's camera_calibration, which names its lens model."""

    image_width: Annotated[int, Field(ge=1, le=100_000), Expected("px: a whole number to 100000")]
    image_height: Annotated[int, Field(ge=1, le=100_000), Expected("px: a whole number to 100000")]
    camera_matrix: OpenCVMatrix
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"] | None = None
    distortion_coefficients: OpenCVMatrix


_PixelCount = Annotated[int, Field(ge=0, le=100_000), Expected("px: a whole number to 100000")]


class RegionOfInterest(ForeignEntry):
    """The part of a sensor that is read out; a size of 0 is all of it."""

    x_offset: _PixelCount = 0
    y_offset: _PixelCount = 0
    width: _PixelCount = 0
    height: _PixelCount = 0


class CameraInfoMessage(ForeignEntry):
    """A printed message of `sensor_msgs/CameraInfo`; K is of the whole sensor."""

    width: _PixelCount
    height: _PixelCount
    k: Annotated[list[FiniteNumber], Field(min_length=9, max_length=9), Expected("9 numbers")]
    d: Annotated[list[FiniteNumber], Field(max_length=100), Expected("up to 100 numbers")]
    distortion_model: str = ""
    binning_x: Annotated[int, Field(ge=0, le=100), Expected("a whole number to 100")] = 0
    binning_y: Annotated[int, Field(ge=0, le=100), Expected("a whole number to 100")] = 0
    roi: RegionOfInterest = RegionOfInterest()


class VispPoseFile(Entry):
    """ViSP's pose vector: m, and axis times angle in rad; ViSP writes no other entries."""

    rows: Annotated[Literal[6], Expected("6, the rows of a pose vector")] = 6
    cols: Annotated[Literal[1], Expected("1, the columns of a pose vector")] = 1
    data: Annotated[
        list[
            Annotated[
                list[Coordinate],
                Field(min_length=1, max_length=1),
                Expected("a list of one number"),
            ]
            | Coordinate
        ],
        Field(min_length=6, max_length=6),
        Expected("6 numbers: x, y, z in m, and axis times angle in rad"),
    ]


class VispCameraEntry(ForeignEntry):
    """The model without distortion of a ViSP camera, px."""

    image_width: Annotated[int, Field(ge=1, le=100_000), Expected("px: a whole number to 100000")]
    image_height: Annotated[int, Field(ge=1, le=100_000), Expected("px: a whole number to 100000")]
    px: FocalLength
    py: FocalLength
    u0: Annotated[float, Field(ge=-1e6, le=1e6), Expected("px, from -1e6 to 1e6")]
    v0: Annotated[float, Field(ge=-1e6, le=1e6), Expected("px, from -1e6 to 1e6")]

    @model_validator(mode="after")
    def _check_pixels(self) -> "VispCameraEntry":
        """Raise a ValueError for pixels of an impossible shape."""
        check_pixel_shape(self.px, self.py)
        return self


_Intrinsics = Annotated[
    list[FiniteNumber], Field(min_length=4, max_length=4), Expected("fu, fv, pu, pv in px")
]


class KalibrCameraEntry(ForeignEntry):
    """A camera in a camchain of Kalibr."""

    camera_model: Literal["pinhole"]
    intrinsics: _Intrinsics
    distortion_model: Literal["radtan", "equidistant", "none"]
    distortion_coeffs: Annotated[list[FiniteNumber], Field(max_length=4)]
    resolution: ImageSize

    @model_validator(mode="after")
    def _check_coefficients(self) -> "KalibrCameraEntry":
        """Raise a ValueError for a number of coefficients that the model does not have."""
        expected = 0 if self.distortion_model == "none" else 4
        if len(self.distortion_coeffs) != expected:
            raise ValueError(
                f"distortion_coeffs: {self.distortion_model} has {expected} coefficients, "
                f"found {len(self.distortion_coeffs)}"
            )
        return self


class MrcalCameraFile(ForeignEntry):
    """A cameramodel of mrcal with a lens of OpenCV; `intrinsics` are fx, fy, cx, cy, distortion."""

    lensmodel: Literal[
        "LENSMODEL_PINHOLE", "LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8"
    ]
    intrinsics: Annotated[list[FiniteNumber], Field(min_length=4, max_length=12)]
    imagersize: ImageSize

    @model_validator(mode="after")
    def _check_coefficients(self) -> "MrcalCameraFile":
        """Raise a ValueError for a number of intrinsics that the model does not have."""
        lens = self.lensmodel.removeprefix("LENSMODEL_")
        expected = 4 + (0 if lens == "PINHOLE" else int(lens[-1]))
        if len(self.intrinsics) != expected:
            raise ValueError(
                f"intrinsics: {self.lensmodel} has {expected}, found {len(self.intrinsics)}"
            )
        return self


_XyzOat = Annotated[
    list[FiniteNumber],
    Field(min_length=6, max_length=6),
    Expected("x, y, z in mm, O, A, T in degrees"),
]
_FormatNumbers = Annotated[
    list[FiniteNumber],
    Field(min_length=6, max_length=16),
    Expected("the 6 to 16 numbers of the file's pose format, in the file's units"),
]


class ViewpointEntry(Entry):
    """A command: a pose in a manufacturer's format, and joint readings in rad or m.

    A pose of a grasp also has the motion to it, and the distance between the fingers on the way.
    """

    name: Name
    xyzoat: _XyzOat | None = None
    pose: _FormatNumbers | None = None
    joints: Annotated[list[Angle], Field(min_length=1, max_length=20)] | None = None
    motion: Literal["free", "straight"] | None = None
    opening_m: Annotated[FiniteNumber, Field(ge=0.0)] | None = None

    @model_validator(mode="after")
    def _check_single_pose(self) -> "ViewpointEntry":
        if (self.xyzoat is None) == (self.pose is None):
            raise ValueError("expected either xyzoat (for the format val_oat) or pose")
        return self


class ViewpointsFile(Entry):
    """A JSON file that `io.write_viewpoints` writes."""

    smartview_viewpoints: Literal[1]
    format: CodecName = "val_oat"
    columns: Annotated[list[PrintableText], Field(max_length=16)] | None = None
    units: dict[str, str]
    viewpoints: list[ViewpointEntry]


CAL_DATA_SCHEMA = TypeAdapter(Annotated[list[CalDataEntry], Field(min_length=1)])
TARGET_SCHEMA = TypeAdapter(TargetFile)
KALIBR_TARGET_SCHEMA = TypeAdapter(KalibrTargetFile)
POSE_SCHEMA = TypeAdapter(QuaternionPoseEntry)
KINEMATIC_MEASUREMENTS_SCHEMA = TypeAdapter(dict[PrintableText | int, KinematicMeasurementEntry])
SAMPLES_SCHEMA = TypeAdapter(SamplesFile)
OPENCV_CAMERA_SCHEMA = TypeAdapter(OpenCVCameraFile)
CAMERA_INFO_SCHEMA = TypeAdapter(CameraInfoMessage)
KALIBR_CAMCHAIN_SCHEMA = TypeAdapter(
    Annotated[dict[PrintableText, KalibrCameraEntry], Field(min_length=1)]
)
MRCAL_CAMERA_SCHEMA = TypeAdapter(MrcalCameraFile)
VISP_POSE_SCHEMA = TypeAdapter(VispPoseFile)
VISP_CAMERA_SCHEMA = TypeAdapter(VispCameraEntry)
VIEWPOINTS_SCHEMA = TypeAdapter(ViewpointsFile)
