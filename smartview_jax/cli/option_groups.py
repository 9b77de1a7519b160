"""Let a subcommand take a group of options as one parameter, so that each is defined once."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any


def with_option_groups(subcommand: Callable[..., None]) -> Callable[..., None]:
    """Return a subcommand whose options are its own parameters and the fields of its groups.

    A group is a keyword parameter annotated with a dataclass. On the command line its fields take
    the parameter's place, one option each; the subcommand itself is called with one object.
    """
    groups: dict[str, Any] = {}
    options: list[inspect.Parameter] = []
    for parameter in inspect.signature(subcommand, eval_str=True).parameters.values():
        group = parameter.annotation
        if isinstance(group, type) and dataclasses.is_dataclass(group):
            groups[parameter.name] = group
            options += inspect.signature(group, eval_str=True).parameters.values()
        else:
            options.append(parameter)

    @functools.wraps(subcommand)
    def call_with_groups(**values: Any) -> None:
        for name, group in groups.items():
            fields = dataclasses.fields(group)
            values[name] = group(**{field.name: values.pop(field.name) for field in fields})
        subcommand(**values)

    # Typer reads its options from the signature and the annotations.
    named = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    call_with_groups.__signature__ = inspect.Signature(named)  # pyright: ignore[reportAttributeAccessIssue]
    call_with_groups.__annotations__ = {option.name: option.annotation for option in named}
    return call_with_groups
