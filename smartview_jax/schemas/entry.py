"""Define what all schemas share: mappings without unknown keys, numbers with unit and range."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Annotated, Any, ClassVar

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

from ..argument_checks import (
    MAX_COORDINATE,
    MAX_NAME_LENGTH,
    name_problem,
    no_name,
    shortened_repr,
    spelling_suggestion,
)

_KIND_PREFIX = "smartview_"
"""What the entry begins with that tells the kind of a file, such as `smartview_dataset`."""


def refuse_other_kind(content: Any, known: Iterable[str]) -> None:
    """Raise a ValueError for a file of another kind than the known keys are of."""
    keys = list(content) if isinstance(content, dict) else []
    this_kind, other = (
        next((key for key in some if str(key).startswith(_KIND_PREFIX)), None)
        for some in (known, keys)
    )
    if this_kind is not None and other is not None and this_kind not in keys:
        raise ValueError(f"a file of the kind {this_kind} is expected, found {other}")


class Entry(BaseModel):
    """A mapping in a file: every key is known, every value of its type, nothing is converted."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", strict=True, allow_inf_nan=False, frozen=True
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, content: Any) -> Any:
        """Raise an error for an unknown key that names the nearest known one."""
        # pydantic's error does not name the known keys. Ignoring a misspelt key would silently
        # leave a default in effect.
        known = list(cls.model_fields)
        unknown = [key for key in content if key not in known] if isinstance(content, dict) else []
        if unknown and cls.model_config.get("extra") == "forbid":
            refuse_other_kind(content, known)
            raise PydanticCustomError(
                "unknown_entry",
                "no entry is called {key}{hint} It has {known}",
                {
                    "key": shortened_repr(unknown[0]),
                    "hint": spelling_suggestion(unknown[0], known) or ".",
                    "known": ", ".join(known),
                },
            )
        return content


@dataclasses.dataclass(frozen=True)
class Expected:
    """A description of the values that a type expects, for its errors and its JSON schema."""

    description: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        """Wrap the type's validation, replacing its error message by the description."""
        return core_schema.no_info_wrap_validator_function(self._validate, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON schema with the description, which editors show."""
        return {**handler(schema), "description": self.description}

    def _validate(self, value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError as error:
            # An error inside a part of the value already has its own message and path.
            if any(problem["loc"] for problem in error.errors(include_url=False)):
                raise
            raise PydanticCustomError(
                "other_value",
                "expected {description}, found {found}",
                {"description": self.description, "found": shortened_repr(value)},
            ) from None


def _check_printable(text: str) -> str:
    """Return a text; raise a ValueError if it is blank or has unprintable characters."""
    if not text.isprintable() or not text.strip():
        raise ValueError  # `Expected` gives the message.
    return text


def _check_name(text: str) -> str:
    """Return a name; raise a ValueError with the reason if it is invalid."""
    if (reason := name_problem(text)) is not None:
        raise ValueError(no_name(text, reason))
    return text


Length = Annotated[float, Field(gt=0.0, le=100.0), Expected("a length in m, above 0 and up to 100")]
Coordinate = Annotated[
    float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE), Expected("m, from -100 to 100")
]
Translation = Annotated[
    list[Coordinate], Field(min_length=3, max_length=3), Expected("x, y, z in m: 3 numbers")
]
UnitComponent = Annotated[float, Field(ge=-1.0001, le=1.0001), Expected("a number from -1 to 1")]
UnitQuaternion = Annotated[
    list[UnitComponent], Field(min_length=4, max_length=4), Expected("w, x, y, z: 4 numbers")
]
Angle = Annotated[float, Field(ge=-100.0, le=100.0), Expected("an angle in rad, from -100 to 100")]
FiniteNumber = Annotated[float, Field(ge=-1e9, le=1e9), Expected("a finite number, up to 1e9")]
Flag = Annotated[bool, Expected("true or false")]
PrintableText = Annotated[
    str,
    Field(min_length=1, max_length=MAX_NAME_LENGTH),
    AfterValidator(_check_printable),
    Expected(f"a name of 1 to {MAX_NAME_LENGTH} printable characters"),
]
"""A path, or a name given by the package or another program; user-given names are `Name`."""
# Checked outside of `Expected`, so that the message gives the reason.
Name = Annotated[PrintableText, AfterValidator(_check_name)]
FocalLength = Annotated[
    float,
    Field(ge=1.0, le=1e7),
    Expected("a focal length over pixel pitch in px, from 1 to 1e7"),
]

MAX_PIXEL_RATIO = 10.0
"""Largest ratio of a pixel's sides: up to 2 on sensors, twice as much with interlaced lines."""


def check_pixel_shape(alpha_u: float, alpha_v: float) -> None:
    """Raise a ValueError for focal lengths in px that imply an impossible pixel shape."""
    ratio = max(alpha_u / alpha_v, alpha_v / alpha_u)
    if ratio > MAX_PIXEL_RATIO:
        raise ValueError(
            f"focal lengths {alpha_u:g} and {alpha_v:g} px: pixels {ratio:.3g} times as long as "
            f"wide; expected at most {MAX_PIXEL_RATIO:g} times"
        )
