"""Print the result of a subcommand as one JSON document, for programs that call it."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import typer


def print_document(subcommand: str, content: Mapping[str, Any]) -> None:
    """Print a document with the subcommand's name and the package's version.

    JSON has no NaN and no infinity: these are null.
    """
    import json

    from .. import __version__

    # The name and the version come first, so that a program can tell what it reads.
    document = {"smartview": subcommand, "version": __version__, **content}
    typer.echo(json.dumps(_plain(document), indent=1, allow_nan=False))


def transform_document(transform: Any) -> dict[str, list[float]]:
    """Return a rigid transform (`jaxlie.SE3`) as calibration files have it: m, unit quaternion."""
    # jaxlie stores the quaternion first.
    numbers = [float(x) for x in transform.wxyz_xyz]
    return {"translation": numbers[4:], "quaternion_wxyz": numbers[:4]}


def _plain(value: Any) -> Any:
    """Return a value of lists, texts and finite numbers only."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, str | bool) or value is None:
        return value
    # Arrays of NumPy and JAX, and their scalars.
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    # After the texts, which are sequences too.
    if isinstance(value, Sequence):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, int) else str(value)
