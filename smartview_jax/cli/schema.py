"""Define `smartview schema`, which prints the JSON schemas of files for editors."""

from enum import StrEnum
from typing import Annotated

import typer


class SchemaName(StrEnum):
    """The files that have a JSON schema."""

    DATASET = "dataset"
    CALIBRATION = "calibration"
    OBJECT = "object"
    RIG = "rig"


def schema(of: Annotated[SchemaName, typer.Argument(help="Kind of file.")]) -> None:
    """Print the JSON schema of dataset.yaml, calibration.yaml, an object or a rig, for editors.

    Editors with a YAML language server check a file that begins with the line
    `# yaml-language-server: $schema=dataset.schema.json`, where the schema was saved next to it.
    """
    from ..schemas.json_schema import json_schema

    typer.echo(json_schema(of.value), nl=False)
