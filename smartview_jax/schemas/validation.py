"""Validate the content of a file; errors name the file and the entry."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from pydantic import ValidationError

from ..argument_checks import errors_at, shortened_repr, spelling_suggestion
from ..files import dump_json, dump_yaml, read_yaml, write_atomically

_MAX_REPORTED_ERRORS = 5
"""Largest number of wrong entries that an error message names."""

Content = TypeVar("Content", covariant=True)


@runtime_checkable
class Schema(Protocol[Content]):
    """A schema that validates content, as `pydantic.TypeAdapter` does.

    The protocol stands in for that class, which the run-time type checker of the tests cannot
    check.
    """

    def validate_python(self, found: Any, /) -> Content:
        """Return the content converted to its type, or raise a `ValidationError`."""
        ...


def validate_content(
    content: Any, schema: Schema[Content], source: str | os.PathLike[str] = ""
) -> Content:
    """Validate the content of a file, and return it as the type of its schema.

    Args:
        content: mappings, lists and values, as read from YAML or JSON.
        source: the file, or the file and an entry in it, for error messages; may be empty.

    Raises:
        ValueError: the content does not fit; the message names the file, the wrong entries, the
            values found and the values expected.
    """
    try:
        return schema.validate_python(content)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        messages = [_error_message(problem, content) for problem in errors[:_MAX_REPORTED_ERRORS]]
        if len(errors) > _MAX_REPORTED_ERRORS:
            messages.append(f"and {len(errors) - _MAX_REPORTED_ERRORS} more")
        start = f"{source}: " if str(source) else ""
        raise ValueError(start + "; ".join(dict.fromkeys(messages))) from None


def read_validated(path: str | os.PathLike[str], schema: Schema[Content]) -> Content:
    """Read a mapping from a YAML (or JSON) file, and return it as the type of its schema.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not readable, or its content does not fit; the message names the file.
    """
    return validate_content(read_yaml(path), schema, path)


def refuse_unreadable(content: Any, schema: Schema[object], source: str | os.PathLike[str]) -> None:
    """Raise a ValueError if a file with this content would be refused when it is read.

    Args:
        content: mappings, lists and values, as they would be read from YAML or JSON.
        schema: schema by which a reader validates the file.
        source: the file that would be written, for the message.
    """
    with errors_at(f"{source}: not written, it could not be read back"):
        validate_content(content, schema)


def write_validated(
    path: str | os.PathLike[str], content: Mapping[str, Any], schema: Schema[object]
) -> Path:
    """Write a mapping as YAML, or as JSON if the name ends in `.json`, completely or not at all.

    Args:
        schema: schema by which a reader validates the file.

    Raises:
        ValueError: the file would be refused when it is read; nothing is written.
    """
    refuse_unreadable(content, schema, path)
    as_json = Path(path).suffix.lower() == ".json"
    return write_atomically(path, dump_json(content) if as_json else dump_yaml(content))


def _error_message(problem: Any, content: Any) -> str:
    """Return one problem of a `ValidationError` as a sentence that names the entry."""
    # pydantic's messages name Python types and tags, which mean nothing to an author of YAML.
    kind, context, value = problem["type"], problem.get("ctx", {}), problem["input"]
    path = entry_path(problem["loc"], content, keep_last=kind == "missing")
    prefix = f"{path}: " if path else ""
    if kind == "missing":
        return f"entry {path!r} is missing"
    if kind == "literal_error":
        return _choice_message(path, context["expected"], value)
    if kind == "union_tag_invalid":
        key = context["discriminator"].strip("'")
        return _choice_message(f"{path}.{key}".strip("."), context["expected_tags"], context["tag"])
    if kind == "union_tag_not_found" and isinstance(value, dict):
        key = context["discriminator"].strip("'")
        return f"entry {f'{path}.{key}'.strip('.')!r} is missing"
    if kind in ("model_type", "model_attributes_type", "dict_type", "union_tag_not_found"):
        return f"{prefix}expected a mapping, found {shortened_repr(value)}"
    if kind in ("unknown_entry", "other_value"):
        return f"{prefix}{problem['msg']}"
    if kind == "value_error":
        return f"{prefix}{context['error']}"
    message = problem["msg"].replace("Input should be", "expected")
    return f"{prefix}{message}, found {shortened_repr(value)}"


def _choice_message(path: str, expected: str, found: object) -> str:
    """Return the message for an entry with a fixed set of values, suggesting the nearest."""
    # pydantic lists the values as text, such as "'a', 'b' or 'c'".
    known = [word.strip("' ") for part in expected.split(",") for word in part.split(" or ")]
    start = f"{path} is one of" if len(known) > 1 else f"{path}: expected"
    end = (
        f"; found {shortened_repr(found)}" if len(known) > 1 else f", found {shortened_repr(found)}"
    )
    return f"{start} {', '.join(known)}{end}{spelling_suggestion(found, known)}"


def entry_path(location: Sequence[str | int], content: Any, keep_last: bool = False) -> str:
    """Return the dotted path of an entry in the file.

    The steps of pydantic's location include the alternatives of a union; they are not in the file
    and are left out. The last step of a missing entry is kept on request.
    """
    # A step that is found in the content is part of the path; pydantic inserted the others, tags
    # of unions and names of types.
    steps: list[str] = []
    for number, step in enumerate(location, start=1):
        if isinstance(step, str) and isinstance(content, dict) and step in content:
            content = content[step]
            steps.append(step)
        elif isinstance(step, int) and isinstance(content, list) and step < len(content):
            content = content[step]
            steps.append(str(step))
        elif keep_last and number == len(location):
            steps.append(str(step))
    return ".".join(steps)
