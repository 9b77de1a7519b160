"""Define the schemas of the files that `RigFit.save` writes next to its cameras' calibrations."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, model_validator

from .arm import TransformEntry
from .calibration import UncertaintyEntry
from .covariances import check_covariance
from .entry import Entry, Expected, FiniteNumber, PrintableText

_Name = Annotated[
    str, Field(pattern=r"^[\w-]{1,200}$"), Expected("a name of letters, digits, '_' and '-'")
]
_Names = Annotated[list[PrintableText], Field(max_length=1000), Expected("names of parameters")]

_Freedom = Annotated[float, Field(gt=0.0, le=1e12), Expected("a number above 0, or null")]

_PoseRow = Annotated[
    list[FiniteNumber | None], Field(max_length=6), Expected("a row of 6 numbers or null")
]

END_MARK = "smartview_rig"
"""Value of the last entry, `end`, by which a truncated file is recognised."""


class CalibratedRigFile(Entry):
    """The cameras of a rig, and the joint covariance of their parameters.

    `parameters_of` has, for each camera, the rig's name of each of its parameters in their order;
    names that several cameras have in common are parameters that they share.
    """

    smartview_rig: Literal[1]
    run: PrintableText | None = None
    cameras: Annotated[dict[_Name, PrintableText], Field(min_length=1)]
    parameters_of: dict[_Name, _Names]
    uncertainty: UncertaintyEntry | None = None
    end: Literal["smartview_rig"]

    @model_validator(mode="after")
    def _check_consistency(self) -> "CalibratedRigFile":
        if set(self.parameters_of) != set(self.cameras):
            raise ValueError(
                f"parameters_of: expected the cameras {', '.join(self.cameras)}, found "
                f"{', '.join(self.parameters_of)}"
            )
        known = {name for names in self.parameters_of.values() for name in names}
        for name in () if self.uncertainty is None else self.uncertainty.parameters:
            if name not in known:
                raise ValueError(f"uncertainty: no camera has a parameter {name!r}")
        if self.uncertainty is not None and self.uncertainty.noise is None:
            raise ValueError("uncertainty: the entry 'noise' is missing")
        return self


CALIBRATED_RIG_SCHEMA = TypeAdapter(CalibratedRigFile)

AXES = tuple(f"{part}.{axis}" for part in ("translation", "rotation") for axis in "xyz")
"""Names of the rows of the covariance."""


class RelativePoseFile(Entry):
    """A transform, and the covariance of its translation (m) and of a rotation after it (rad).

    Both are along the axes of the first frame. Degrees of freedom, where they are listed, are of
    the six standard deviations; null is infinite. The variance of a number that nothing determines
    is null as well, and its covariance with the others zero.
    """

    smartview_relative_pose: Literal[1]
    run: PrintableText | None = None
    first_from_second: TransformEntry
    covariance: Annotated[list[_PoseRow], Field(max_length=6), Expected("a matrix of 6 rows")]
    degrees_of_freedom: list[_Freedom | None] | None = None
    end: Literal["smartview_relative_pose"]

    @model_validator(mode="after")
    def _check_covariance(self) -> "RelativePoseFile":
        # A number without a finite variance is uncorrelated with the others: any variance will do.
        rows = [
            [1.0 if entry is None and i == j else entry for j, entry in enumerate(row)]
            for i, row in enumerate(self.covariance)
        ]
        if any(entry is None for row in rows for entry in row):
            raise ValueError("covariance: null stands for an infinite variance, on the diagonal")
        for i, row in enumerate(self.covariance):
            if None in row and any(row[:i] + row[i + 1 :]):
                raise ValueError("covariance: expected zeros next to an infinite variance (null)")
        check_covariance([[float(entry or 0.0) for entry in row] for row in rows], AXES)
        if self.degrees_of_freedom is not None and len(self.degrees_of_freedom) != len(AXES):
            raise ValueError(f"degrees_of_freedom: expected {len(AXES)} numbers")
        return self


RELATIVE_POSE_SCHEMA = TypeAdapter(RelativePoseFile)
