"""Define the schema of `calibration.yaml`, the file that `Calibration.save` writes."""

import os
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, TypeAdapter, model_validator

from .arm import ArmEntry, TransformEntry
from .calibration_content import calibration_content
from .covariances import check_covariance
from .entry import (
    Entry,
    Expected,
    FiniteNumber,
    FocalLength,
    PrintableText,
    check_pixel_shape,
    refuse_other_kind,
)
from .validation import validate_content

END_MARK = "smartview_calibration"
"""Value of the last entry, `end`, by which a truncated file is recognised."""

_PrincipalPoint = Annotated[
    float, Field(ge=-1e6, le=1e6), Expected("a principal point in px, from -1e6 to 1e6")
]
_Coefficient = Annotated[
    float, Field(ge=-1e4, le=1e4), Expected("a coefficient of the robot's error, up to 1e4")
]
_TargetScale = Annotated[
    float,
    Field(ge=1e-3, le=1e3),
    Expected("the target's true size over its stated one, from 0.001 to 1000"),
]
_ImageSide = Annotated[
    int, Field(ge=1, le=100_000), Expected("px: a whole number from 1 to 100000")
]

ImageSize = Annotated[
    list[_ImageSide], Field(min_length=2, max_length=2), Expected("[width, height] in px")
]


_HalfSize = Annotated[
    float, Field(gt=0.0, le=1e3), Expected("half of a target's longer side in m, up to 1000")
]
_Displacement = Annotated[
    float, Field(ge=-1.0, le=1.0), Expected("a displacement of the target's edge in m, up to 1")
]


class ShapeCoefficientsEntry(Entry):
    """The displacements of a target's edge, m."""

    bow_x: _Displacement
    bow_xy: _Displacement
    bow_y: _Displacement
    aspect: _Displacement
    shear: _Displacement


class TargetShapeEntry(Entry):
    """The true shape of a flat target."""

    centre: Annotated[list[FiniteNumber], Field(min_length=2, max_length=2)]
    half_size: _HalfSize
    mean_products: Annotated[list[FiniteNumber], Field(min_length=3, max_length=3)]
    coefficients: ShapeCoefficientsEntry


class UnitsEntry(Entry):
    """The units of a calibration, stated although fixed, so that no file has wrong ones."""

    length: Literal["m"]
    angle: Literal["rad"]
    image: Literal["px"]


class LensEntry(Entry):
    """A lens: the name and numbers of its model, which `cameras` checks."""

    model_config: ClassVar[Any] = Entry.model_config | {"extra": "allow"}
    __pydantic_extra__: dict[str, FiniteNumber]  # pyright: ignore[reportIncompatibleVariableOverride]

    model: PrintableText


class PinholeEntry(Entry):
    """A camera's four pinhole numbers."""

    alpha_u: FocalLength
    alpha_v: FocalLength
    u0: _PrincipalPoint
    v0: _PrincipalPoint

    @model_validator(mode="after")
    def _check_pixels(self) -> "PinholeEntry":
        """Raise a ValueError for pixels of an impossible shape."""
        check_pixel_shape(self.alpha_u, self.alpha_v)
        return self


class CameraEntry(PinholeEntry):
    """A camera's pinhole numbers, lens and picture."""

    image_size: ImageSize
    lens: LensEntry


NumberRow = Annotated[
    list[FiniteNumber], Field(max_length=1000), Expected("a row of up to 1000 numbers")
]
_NumberArray = Annotated[
    list[FiniteNumber | NumberRow], Field(max_length=1000), Expected("up to 1000 numbers")
]
_Distance = Annotated[float, Field(gt=0.0, le=1e4), Expected("a distance in m, above 0 up to 1e4")]


def _field_value_tag(value: Any) -> str:
    """Return the tag of a part of a robot error field: a nested field, an arm, or numbers."""
    # With a tag pydantic tries one type only. Without it, a wrong number inside a nested field
    # would be reported once for every possible type.
    if isinstance(value, dict):
        return "field" if "model" in value else "arm"
    return "numbers" if isinstance(value, list) else "number"


class ErrorFieldEntry(Entry):
    """A smooth error of the robot: its model's name and parts, which `robot_errors` checks."""

    model_config: ClassVar[Any] = Entry.model_config | {"extra": "allow"}
    __pydantic_extra__: dict[  # pyright: ignore[reportIncompatibleVariableOverride]
        str,
        Annotated[
            Annotated["ErrorFieldEntry", Tag("field")]
            | Annotated[ArmEntry, Tag("arm")]
            | Annotated[_NumberArray, Tag("numbers")]
            | Annotated[FiniteNumber, Tag("number")],
            Discriminator(_field_value_tag),
        ],
    ]

    model: PrintableText
    reach: _Distance | None = None


class RobotErrorEntry(Entry):
    """The systematic error of the robot's reports: its field and the fitted coefficients."""

    field: ErrorFieldEntry
    coefficients: dict[str, _Coefficient]


_Coordinate = Annotated[float, Field(ge=-1e4, le=1e4), Expected("m, from -10000 to 10000")]


class RegionEntry(Entry):
    """The region of the views' camera positions; see `geometry.ViewedRegion`."""

    side: Literal["+z", "-z", "both"]
    plane: _Coordinate
    middle: Annotated[
        list[_Coordinate], Field(min_length=3, max_length=3), Expected("x, y, z in m: 3 numbers")
    ]
    reach: _Distance
    distance: Annotated[
        list[_Distance],
        Field(min_length=2, max_length=2),
        Expected("the smallest and the largest distance in m: 2 numbers"),
    ]
    lowest_tool: _Coordinate | None = None

    @model_validator(mode="after")
    def _check_distance_order(self) -> "RegionEntry":
        minimum, maximum = self.distance
        if minimum > maximum:
            raise ValueError(f"distance: expected the smallest first, found {self.distance}")
        return self


_Sigma = Annotated[
    float, Field(gt=0.0, le=1e6), Expected("a standard deviation, above 0 up to 1e6")
]


_SigmaOrZero = Annotated[
    float, Field(ge=0.0, le=1e6), Expected("a standard deviation, from 0 to 1e6")
]


_SixRows = Annotated[
    list[NumberRow], Field(min_length=6, max_length=6), Expected("six rows of six numbers")
]


class PoseDirectionsEntry(Entry):
    """Covariances of the error of a reported pose that follow the axes of tool and base (m, rad).

    It is a twist at the tool, translation first.
    """

    in_tool: _SixRows
    in_base: _SixRows

    @model_validator(mode="after")
    def _check_rows(self) -> "PoseDirectionsEntry":
        """Raise a ValueError for rows that have not six numbers."""
        for name in ("in_tool", "in_base"):
            if any(len(row) != 6 for row in getattr(self, name)):
                raise ValueError(f"{name}: expected six rows of six numbers")
        return self


class NoiseEntry(Entry):
    """Standard deviations of pixels (px) and reported poses (m, rad); null if infinite."""

    pixel: _Sigma
    translation: _Sigma | None
    rotation: _Sigma | None
    field: list[_Sigma]
    white_pixel: _Sigma | None = None
    directions: PoseDirectionsEntry | None = None


class DepthBiasEntry(Entry):
    """The bias of a camera's depths: true depth = scale * measured depth + offset (m)."""

    scale: Annotated[float, Field(gt=0.0, le=100.0), Expected("true over measured depth")]
    offset: FiniteNumber


class DepthSensorEntry(DepthBiasEntry):
    """Bias and noise of the depth sensor whose points or depths were fitted; lengths in m."""

    scale_std: _SigmaOrZero
    offset_std: _SigmaOrZero
    correlation: Annotated[float, Field(ge=-1.0, le=1.0), Expected("a correlation")]
    across_std: _Sigma | None = None
    along_std: _SigmaOrZero
    along_growth: _SigmaOrZero = 0.0
    common_std: _SigmaOrZero = 0.0


class UncertaintyEntry(Entry):
    """The covariance of the parameters that a fit estimated, in their own units."""

    parameters: Annotated[
        list[PrintableText], Field(max_length=1000), Expected("names of parameters")
    ]
    covariance: Annotated[list[NumberRow], Field(max_length=1000), Expected("a square matrix")]
    noise: NoiseEntry | None = None
    pixel_sigma: _Sigma
    smallest_singular_value: FiniteNumber
    depth_sensor: DepthSensorEntry | None = None

    @model_validator(mode="after")
    def _check_covariance(self) -> "UncertaintyEntry":
        """Raise a ValueError for a matrix that is not a covariance of the parameters."""
        check_covariance(self.covariance, self.parameters)
        if len(set(self.parameters)) != len(self.parameters):
            twice = next(name for name in self.parameters if self.parameters.count(name) > 1)
            raise ValueError(f"parameters: {twice} occurs twice")
        return self


class _CalibrationFile(Entry):
    smartview_calibration: Literal[1, 2]
    run: PrintableText | None = None
    source: str | None = None
    warnings: list[str] | None = None
    units: UnitsEntry
    camera: CameraEntry
    target_scale: _TargetScale
    target_shape: TargetShapeEntry | None = None
    depth_bias: DepthBiasEntry | None = None
    robot_error: RobotErrorEntry | None = None
    region: RegionEntry | None = None
    pictures: list[str] | None = None
    uncertainty: UncertaintyEntry | None = None
    end: Literal["smartview_calibration"] | None = None

    @model_validator(mode="after")
    def _check_not_truncated(self) -> "_CalibrationFile":
        """Raise a ValueError for a file that may be truncated.

        The robot's correction comes last in a file, so its loss would not be noticed.
        """
        if self.smartview_calibration == 2 and self.end != END_MARK:
            raise ValueError(f"the last line, 'end: {END_MARK}', is missing: truncated file")
        # Version 1 had no end mark, but always the last entry robot_error, which may be null.
        if self.smartview_calibration == 1 and "robot_error" not in self.model_fields_set:
            raise ValueError(
                "a file of version 1 without robot_error may be truncated: if it is complete, add "
                "the line 'robot_error: null'"
            )
        return self


class EyeInHandFile(_CalibrationFile):
    """A camera on the tool and a target fixed in the base frame."""

    mount: Literal["eye_in_hand"]
    camera_from_tool: TransformEntry
    base_from_world: TransformEntry


class EyeToHandFile(_CalibrationFile):
    """A camera fixed in the base frame and a target on the tool."""

    mount: Literal["eye_to_hand"]
    camera_from_base: TransformEntry
    tool_from_world: TransformEntry


class HandToHandFile(_CalibrationFile):
    """A camera on the tool of one arm and a target on the tool of another."""

    mount: Literal["hand_to_hand"]
    camera_from_tool: TransformEntry
    other_tool_from_world: TransformEntry
    base_from_other_base: TransformEntry


def _of_this_kind(content: Any) -> Any:
    """Return the content; raise a ValueError if it is not a calibration's."""
    # Files of other kinds have no mount, by which the schema is chosen.
    refuse_other_kind(content, [END_MARK])
    return content


CALIBRATION_SCHEMA: TypeAdapter[EyeInHandFile | EyeToHandFile | HandToHandFile] = TypeAdapter(
    Annotated[
        EyeInHandFile | EyeToHandFile | HandToHandFile,
        Field(discriminator="mount"),
        BeforeValidator(_of_this_kind),
    ]
)


def read_calibration_file(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the checked content of a calibration file as plain numbers.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: naming the file and the entry that is wrong.
    """
    content = calibration_content(path)
    validate_content(content, CALIBRATION_SCHEMA, path)
    return content


PINHOLE_SCHEMA = TypeAdapter(PinholeEntry)
