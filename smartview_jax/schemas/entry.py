"""Define what all schemas share: mappings without unknown keys, numbers with unit and range."""

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
        """Raise an error for an unknown key that names the nearest known one."""
        # pydantic's own error for an unknown key does not name the known ones. A misspelt key that
        # was ignored would leave a default value in effect without notice.
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
    """A description of the values that a type expects, for its errors and its JSON schema.

    Attributes:
        words: description of the expected value with its unit and range.
    """

    words: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        """Wrap the type's validation, so that its error message is replaced by `words`."""
        return core_schema.no_info_wrap_validator_function(self._check, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON schema with `words` as its description, which editors show."""
        return {**handler(schema), "description": self.words}

    def _check(self, value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError as error:
            # An error inside a part of the value already has a message and a path of its own.
            if any(problem["loc"] for problem in error.errors(include_url=False)):
                raise
            raise PydanticCustomError(
                "other_value",
                "expected {words}, found {found}",
                {"words": self.words, "found": shown(value)},
            ) from None


def _plain_name(name: str) -> str:
    """Return a name; raise a ValueError if it is blank or has unprintable characters."""
    if not name.isprintable() or not name.strip():
        raise ValueError
    return name


FARTHEST = 100.0
"""Largest coordinate of a pose in a file, m: a larger one was given in another unit."""

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
