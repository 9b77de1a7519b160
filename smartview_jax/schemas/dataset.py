"""`dataset.yaml`: what a data-set folder holds; see `io.dataset_folder`."""

import math
import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag, TypeAdapter, model_validator

from .arm import ArmEntry
from .calibration import ImageSize
from .entry import Entry, Name, Said
from .target import TargetEntry

END = "smartview_dataset"

MOST_POINTS = 1_000_000
"""Of a target at all its heights: so many fit into memory for every view."""

LengthUnit = Literal["m", "cm", "mm"]
AngleUnit = Literal["rad", "deg"]
Codec = Literal[
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
]
_Rows = Annotated[int, Field(ge=0, le=10**9), Said("how many rows the file has")]


class CameraSizeEntry(Entry):
    """The pictures' size."""

    image_size: ImageSize


class PosesEntry(Entry):
    """A table of poses, a row a view: its format, units and direction; none of them is guessed."""

    file: Name
    codec: Codec
    length_unit: LengthUnit
    angle_unit: AngleUnit
    direction: Literal["base_from_tool", "tool_from_base"]
    rows: _Rows | None = None


class JointsEntry(Entry):
    """A table of joint readings, a row a view, and the arm they are of: its name or numbers."""

    file: Name
    angle_unit: AngleUnit
    length_unit: LengthUnit
    arm: Annotated[
        Annotated[Name, Tag("a name")] | Annotated[ArmEntry, Tag("numbers")],
        Discriminator(lambda arm: "numbers" if isinstance(arm, dict) else "a name"),
    ]
    rows: _Rows | None = None


def _pattern(text: str) -> str:
    rest = text.replace("{view}", "").replace("{height}", "")
    if "{view}" not in text or re.search("[{}]", rest) or not rest.isprintable():
        raise ValueError
    return text


class PicturesEntry(Entry):
    """The pictures' file names, as one pattern."""

    pattern: Annotated[
        str,
        Field(max_length=200),
        AfterValidator(_pattern),
        Said("a name with {view} in it, {height} too if there are several, and no other braces"),
    ]


class DetectionsEntry(Entry):
    """What was written to detections.csv."""

    rows: _Rows


class DatasetFile(Entry):
    """A data-set folder's description."""

    smartview_dataset: Literal[1]
    end_mark: Literal[True] | None = None
    camera: CameraSizeEntry
    target: TargetEntry
    mount: Literal["eye_in_hand", "eye_to_hand"] = "eye_in_hand"
    poses: PosesEntry | None = None
    joints: JointsEntry | None = None
    pictures: PicturesEntry | None = None
    detections: DetectionsEntry | None = None
    end: Literal["smartview_dataset"] | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> "DatasetFile":
        if self.end_mark and self.end != END:
            raise ValueError(f"the last line, 'end: {END}', is missing: the file was cut")
        target = self.target
        sides = [getattr(target, name, 1) for name in ("rows", "columns", "squares_x", "squares_y")]
        points = math.prod(sides) * len(target.heights or [0])
        if points > MOST_POINTS:
            raise ValueError(f"target: expected up to {MOST_POINTS} points, found {points}")
        if self.poses is None and self.joints is None:
            raise ValueError("entry 'poses' is missing, and so is 'joints'")
        return self


DATASET = TypeAdapter(DatasetFile)
