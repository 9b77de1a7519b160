"""Generate JSON schemas for editors from the types that validate the files.

`python -m smartview_jax.schemas.json_schema` rewrites the schemas that are part of the package.
"""

import json
from pathlib import Path

from pydantic import TypeAdapter

from ..files import write_atomically
from .calibrated_rig import CALIBRATED_RIG_SCHEMA
from .calibration import CALIBRATION_SCHEMA
from .dataset import DatasetFile
from .object_model import OBJECT_MODEL_SCHEMA
from .rig import RigFile

SCHEMAS = {
    # A folder with one camera, or with several.
    "dataset": TypeAdapter(DatasetFile | RigFile),
    "calibration": CALIBRATION_SCHEMA,
    "object": OBJECT_MODEL_SCHEMA,
    "rig": CALIBRATED_RIG_SCHEMA,
}
"""Schemas by the name of the file without its ending; `rig` is a calibrated rig's."""

_FILES = {"object": "object.json", "rig": "rig.joint.yaml"}
"""Names of the files that are not called as their schema, with the ending .yaml."""


def json_schema(name: str) -> str:
    """Return the JSON schema of a file, as text, by its name in `SCHEMAS`."""
    content = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **SCHEMAS[name].json_schema(),
        "title": f"{_FILES.get(name, f'{name}.yaml')} of smartview_jax",
    }
    return json.dumps(content, indent=1) + "\n"


def schema_path(name: str) -> Path:
    """Return the path of a schema that is part of the package."""
    return Path(__file__).with_name(f"{name}.schema.json")


if __name__ == "__main__":
    for file in SCHEMAS:
        write_atomically(schema_path(file), json_schema(file))
