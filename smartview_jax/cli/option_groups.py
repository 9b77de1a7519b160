"""Let a subcommand take a group of options as one parameter, so that each is defined once."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any


def with_option_groups(subcommand: Callable[..., None]) -> Callable[..., None]:
    """Return a subcommand whose options are its own parameters and the fields of its groups.

    A group is a parameter annotated with a dataclass, or a field of a group that is. On the command
    line its fields take its place, one option each; the subcommand is called with one object.
    """
    options = options_of(subcommand)

    @functools.wraps(subcommand)
    def call_with_groups(**values: Any) -> None:
        _called_with(subcommand, values)

    # Typer reads its options from the signature and the annotations.
    named = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    call_with_groups.__signature__ = inspect.Signature(named)  # pyright: ignore[reportAttributeAccessIssue]
    call_with_groups.__annotations__ = {option.name: option.annotation for option in named}
    return call_with_groups


def options_of(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the parameters of a function, with the fields of each group in the group's place."""
    options = []
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        group = parameter.annotation
        options += options_of(group) if _is_group(group) else [parameter]
    return options


def _called_with(function: Callable[..., Any], values: dict[str, Any]) -> Any:
    """Return what a function returns for the values of its options, by their names."""
    arguments = {}
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        group = parameter.annotation
        arguments[name] = _called_with(group, values) if _is_group(group) else values[name]
    return function(**arguments)


def _is_group(annotation: Any) -> bool:
    """Return whether an annotation is a dataclass, whose fields are options."""
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation)
