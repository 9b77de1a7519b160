"""Define the schema of a file with the pose of one camera or one arm's base in another's frame."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, model_validator

from .arm import TransformEntry
from .calibration import NumberRow
from .covariances import check_covariance
from .entry import Entry, Expected, PrintableText

AXES = tuple(f"{part}.{axis}" for part in ("translation", "rotation") for axis in "xyz")
"""Names of the rows of the covariance."""


class RelativePoseFile(Entry):
    """A transform, and the covariance of its translation (m) and of a rotation after it (rad).

    Both are along the axes of the first frame.
    """

    smartview_relative_pose: Literal[1]
    run: PrintableText | None = None
    first_from_second: TransformEntry
    covariance: Annotated[list[NumberRow], Field(max_length=6), Expected("a matrix of 6 rows")]
    end: Literal["smartview_relative_pose"]

    @model_validator(mode="after")
    def _check_covariance(self) -> "RelativePoseFile":
        check_covariance(self.covariance, AXES)
        return self


RELATIVE_POSE_SCHEMA = TypeAdapter(RelativePoseFile)
