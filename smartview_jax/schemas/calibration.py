"""Define the schema of `calibration.yaml`, the file that `Calibration.save` writes."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Discriminator, Field, Tag, TypeAdapter, model_validator

from .arm import ArmEntry, TransformEntry
from .entry import Entry, Name, Plain, Said

VERSIONS = (1, 2)
"""Versions of the format that can be read; version 2 has an end mark."""

END = "smartview_calibration"
"""Value of the last entry, `end`, by which a truncated file is recognised."""

_Focal = Annotated[
    float, Field(gt=0.0, le=1e7), Said("a focal length over pixel pitch in px, above 0 up to 1e7")
]
_Centre = Annotated[
    float, Field(ge=-1e6, le=1e6), Said("a principal point in px, from -1e6 to 1e6")
]
_Coefficient = Annotated[
    float, Field(ge=-1e4, le=1e4), Said("a coefficient of the robot's error, up to 1e4")
]
_Scale = Annotated[
    float,
    Field(ge=1e-3, le=1e3),
    Said("the target's true size over its stated one, from 0.001 to 1000"),
]
_Side = Annotated[int, Field(ge=1, le=100_000), Said("px: a whole number from 1 to 100000")]

ImageSize = Annotated[list[_Side], Field(min_length=2, max_length=2), Said("[width, height] in px")]


class UnitsEntry(Entry):
    """The units of a calibration; there are no others, so that no file is read in a wrong one."""

    length: Literal["m"]
    angle: Literal["rad"]
    image: Literal["px"]


class LensEntry(Entry):
    """A lens: its model's name and numbers, which `cameras` knows."""

    model_config: ClassVar[Any] = Entry.model_config | {"extra": "allow"}
    __pydantic_extra__: dict[str, Plain]  # pyright: ignore[reportIncompatibleVariableOverride]

    model: Name


class PinholeEntry(Entry):
    """A camera's four pinhole numbers."""

    alpha_u: _Focal
    alpha_v: _Focal
    u0: _Centre
    v0: _Centre


class CameraEntry(PinholeEntry):
    """A camera's pinhole numbers, lens and picture."""

    image_size: ImageSize
    lens: LensEntry


_Row = Annotated[list[Plain], Field(max_length=1000), Said("a row of up to 1000 numbers")]
_Numbers = Annotated[list[Plain | _Row], Field(max_length=1000), Said("up to 1000 numbers")]
_Reach = Annotated[float, Field(gt=0.0, le=1e4), Said("a distance in m, above 0 up to 1e4")]


def _part(value: Any) -> str:
    """Return the tag of a part of a robot error field: a nested field, an arm, or numbers."""
    if isinstance(value, dict):
        return "field" if "model" in value else "arm"
    return "numbers" if isinstance(value, list) else "number"


class FieldEntry(Entry):
    """A smooth error of the robot: its model's name and parts, which `robot_errors` knows."""

    model_config: ClassVar[Any] = Entry.model_config | {"extra": "allow"}
    __pydantic_extra__: dict[  # pyright: ignore[reportIncompatibleVariableOverride]
        str,
        Annotated[
            Annotated["FieldEntry", Tag("field")]
            | Annotated[ArmEntry, Tag("arm")]
            | Annotated[_Numbers, Tag("numbers")]
            | Annotated[Plain, Tag("number")],
            Discriminator(_part),
        ],
    ]

    model: Name
    reach: _Reach | None = None


class RobotErrorEntry(Entry):
    """What the robot's reports are wrong by."""

    field: FieldEntry
    coefficients: dict[str, _Coefficient]


_Place = Annotated[float, Field(ge=-1e4, le=1e4), Said("m, from -10000 to 10000")]


class RegionEntry(Entry):
    """From where the target was seen; see `geometry.ViewedRegion`."""

    side: Literal["+z", "-z", "both"]
    plane: _Place
    middle: Annotated[
        list[_Place], Field(min_length=3, max_length=3), Said("x, y, z in m: 3 numbers")
    ]
    reach: _Reach
    distance: Annotated[
        list[_Reach],
        Field(min_length=2, max_length=2),
        Said("the least and the greatest distance in m: 2 numbers"),
    ]
    lowest_tool: _Place | None = None

    @model_validator(mode="after")
    def _is_in_order(self) -> "RegionEntry":
        least, greatest = self.distance
        if least > greatest:
            raise ValueError(f"distance: expected the least before the greatest: {self.distance}")
        return self


class _Calibration(Entry):
    smartview_calibration: Literal[1, 2]
    run: Name | None = None
    warnings: list[str] | None = None
    units: UnitsEntry
    camera: CameraEntry
    target_scale: _Scale
    robot_error: RobotErrorEntry | None = None
    region: RegionEntry | None = None
    end: Literal["smartview_calibration"] | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> "_Calibration":
        """Raise a ValueError for a file that may be truncated.

        The correction of the robot stands last in a file, so its loss would not be noticed.
        """
        if self.smartview_calibration == 2 and self.end != END:
            raise ValueError(f"the last line, 'end: {END}', is missing: the file was cut")
        # Version 1 had no end mark; its last entry, robot_error, may be null but must be there.
        if self.smartview_calibration == 1 and "robot_error" not in self.model_fields_set:
            raise ValueError(
                "a file of version 1 without robot_error looks like one that was cut before it: "
                "if it is whole, add the line 'robot_error: null'"
            )
        return self


class EyeInHandFile(_Calibration):
    """A camera on the tool and a target that stands in the base frame."""

    mount: Literal["eye_in_hand"]
    camera_from_tool: TransformEntry
    base_from_world: TransformEntry


class EyeToHandFile(_Calibration):
    """A camera that stands in the base frame and a target on the tool."""

    mount: Literal["eye_to_hand"]
    camera_from_base: TransformEntry
    tool_from_world: TransformEntry


CALIBRATION: TypeAdapter[EyeInHandFile | EyeToHandFile] = TypeAdapter(
    Annotated[EyeInHandFile | EyeToHandFile, Field(discriminator="mount")]
)

CAMERA_NUMBERS = TypeAdapter(PinholeEntry)
