"""Define the schema of a file with the measured misses of a stylus (`io.misses`)."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from .entry import Entry, Expected, FiniteNumber, Name

Miss = Annotated[
    list[FiniteNumber],
    Field(min_length=2, max_length=3),
    Expected("x and y, or x, y and z: 2 or 3 numbers"),
]


class MissesFile(Entry):
    """Measured misses by the name of the touch, in the world's axes."""

    unit: Literal["mm", "m"]
    misses: Annotated[dict[Name, Miss], Field(min_length=1)]


MISSES_SCHEMA = TypeAdapter(MissesFile)
