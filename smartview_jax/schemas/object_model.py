"""Define the schema of an object model's JSON file (`io.object_models`)."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, TypeAdapter, model_validator

from ..argument_checks import MAX_NAME_LENGTH, nearest_name
from .arm import TransformEntry
from .entry import Entry, Expected, Flag, UnitComponent, UnitQuaternion

END_MARK = "smartview_object"
"""Value of the last entry, `end`, by which a truncated file is recognised."""

MAX_VERTICES = 100_000
"""Largest number of vertices of a model in a file."""

ModelUnit = Literal["m", "cm", "mm"]

# Up to 100 m, in millimetres; the model itself checks the object's extent in metres.
_Number = Annotated[float, Field(ge=-1e5, le=1e5), Expected("a number from -1e5 to 1e5")]
_Index = Annotated[
    int, Field(ge=0, lt=MAX_VERTICES), Expected("the number of a vertex or face, from 0")
]
_Point = Annotated[list[_Number], Field(min_length=3, max_length=3), Expected("x, y, z: 3 numbers")]
_UnitVector = Annotated[
    list[UnitComponent],
    Field(min_length=3, max_length=3),
    Expected("x, y, z of a unit vector: 3 numbers"),
]
_Loop = Annotated[
    list[_Index], Field(min_length=3, max_length=10_000), Expected("3 or more vertices")
]
_Size = Annotated[float, Field(ge=0.0, le=1e5), Expected("a length, not negative, up to 1e5")]
_SquareMatrix = Annotated[list[list[_Number]], Field(max_length=6000), Expected("rows of numbers")]


def _check_label(text: str) -> str:
    """Return a name, which may be empty; raise a ValueError for unprintable characters."""
    if not text.isprintable():
        raise ValueError
    # Earlier versions wrote names such as "#1" and " top", which are invalid now.
    return nearest_name(text)


_Label = Annotated[
    str,
    Field(max_length=MAX_NAME_LENGTH),
    AfterValidator(_check_label),
    Expected(f"a name of up to {MAX_NAME_LENGTH} printable characters"),
]


class FaceEntry(Entry):
    """A flat face: its vertices counter-clockwise as seen from outside, and its holes."""

    name: _Label = ""
    loop: _Loop
    holes: list[_Loop] = Field(default_factory=list)
    graspable: Flag | None = None


class GraspEntry(Entry):
    """A pose of the gripper on a face; lengths in the file's unit."""

    name: _Label
    face: _Index
    object_from_tool: TransformEntry
    opening: _Size
    depth: _Size
    tolerance: _Size


class SymmetryEntry(Entry):
    """The rotations that map the object onto itself, as unit quaternions, real part first."""

    confirmed: Flag
    centre: _Point
    rotations: Annotated[
        list[UnitQuaternion], Field(min_length=1, max_length=1000), Expected("1 to 1000 rotations")
    ]
    axis: _UnitVector | None = None


class CovarianceEntry(Entry):
    """The vertices' covariance due to the pictures, in the file's unit squared.

    Either xx, xy, xz, yy, yz, zz of each vertex, or the matrix of all coordinates together.
    """

    per_vertex: Annotated[
        list[
            Annotated[
                list[_Number], Field(min_length=6, max_length=6), Expected("xx, xy, xz, yy, yz, zz")
            ]
        ]
        | None,
        Field(max_length=MAX_VERTICES),
    ] = None
    full: _SquareMatrix | None = None

    @model_validator(mode="after")
    def _check_one_form(self) -> "CovarianceEntry":
        if (self.per_vertex is None) == (self.full is None):
            raise ValueError("expected either per_vertex or full")
        return self


class ObjectModelFile(Entry):
    """A model of an object: vertices, edges, faces, grasps, symmetry and uncertainty."""

    smartview_object: Literal[1]
    unit: ModelUnit
    name: _Label = ""
    provenance: list[Annotated[str, Field(max_length=10_000)]] = Field(default_factory=list)
    planar_tolerance: Annotated[
        float, Field(gt=0.0, le=1.0), Expected("a fraction of a face's extent, above 0 up to 1")
    ] = 0.01
    tolerance: _Size = 0.0
    vertices: Annotated[
        list[_Point], Field(max_length=MAX_VERTICES), Expected(f"up to {MAX_VERTICES} points")
    ]
    edges: list[
        Annotated[list[_Index], Field(min_length=2, max_length=2), Expected("two vertices")]
    ] = Field(default_factory=list)
    faces: list[FaceEntry] = Field(default_factory=list)
    grasps: list[GraspEntry] = Field(default_factory=list)
    symmetry: SymmetryEntry | None = None
    covariance: CovarianceEntry | None = None
    calibration_factor: _SquareMatrix | None = None
    end: Literal["smartview_object"]

    # Checked first, because for another kind of file every single entry would be reported.
    @model_validator(mode="before")
    @classmethod
    def _check_kind(cls, content: Any) -> Any:
        """Raise an error for a file of another kind, and for a truncated one."""
        if isinstance(content, dict) and "smartview_object" not in content:
            raise ValueError("not an object model: the entry 'smartview_object' is missing")
        if isinstance(content, dict) and "end" not in content:
            raise ValueError(f"the last entry, 'end': '{END_MARK}', is missing: truncated file")
        return content


OBJECT_MODEL_SCHEMA = TypeAdapter(ObjectModelFile)
