"""The grammar of all schemas: mappings without unknown keys, numbers with a unit and a range."""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import PydanticCustomError, core_schema

from .words import nearest, shown


class Entry(BaseModel):
    """A mapping in a file: every key is known, every value of its type, nothing is converted."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _names_unknown_keys(cls, content: Any) -> Any:
        """Refuse an unknown key with the nearest known one: a misspelt key is never ignored."""
        known = list(cls.model_fields)
        unknown = [key for key in content if key not in known] if isinstance(content, dict) else []
        if unknown and cls.model_config.get("extra") == "forbid":
            raise PydanticCustomError(
                "unknown_entry",
                "no entry is called {key}{hint} It has {known}",
                {
                    "key": shown(unknown[0]),
                    "hint": nearest(unknown[0], known) or ".",
                    "known": ", ".join(known),
                },
            )
        return content


@dataclasses.dataclass(frozen=True)
class Said:
    """Mark a type by what is expected, in words, for its errors and its JSON schema.

    Attributes:
        words: the expected value with its unit and range.
    """

    words: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        """Wrap the type's own check, so that its complaint becomes ours."""
        return core_schema.no_info_wrap_validator_function(self._check, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the type where an editor shows it."""
        return {**handler(schema), "description": self.words}

    def _check(self, value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError as error:
            # A part that is wrong has its own words and its own path.
            if any(problem["loc"] for problem in error.errors(include_url=False)):
                raise
            raise PydanticCustomError(
                "other_value",
                "expected {words}, found {found}",
                {"words": self.words, "found": shown(value)},
            ) from None


def _plain_name(name: str) -> str:
    """Refuse what no file system takes, or no person can see."""
    if not name.isprintable() or not name.strip():
        raise ValueError
    return name


FARTHEST = 100.0
"""Largest coordinate of a pose in a file, m: no cell is larger; what is, is in another unit."""

Length = Annotated[float, Field(gt=0.0, le=100.0), Said("a length in m, above 0 and up to 100")]
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST), Said("m, from -100 to 100")]
Angle = Annotated[float, Field(ge=-100.0, le=100.0), Said("an angle in rad, from -100 to 100")]
Plain = Annotated[float, Field(ge=-1e9, le=1e9), Said("a finite number, up to 1e9")]
Flag = Annotated[bool, Said("true or false")]
Name = Annotated[
    str,
    Field(min_length=1, max_length=200),
    AfterValidator(_plain_name),
    Said("a name of 1 to 200 printable characters"),
]
