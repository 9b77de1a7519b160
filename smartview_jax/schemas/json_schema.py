"""JSON schemas for editors, made from the types that files are read through.

`python -m smartview_jax.schemas.json_schema` writes those that ship in the package anew.
"""

import json
from pathlib import Path

from ..files import write_atomically
from .calibration import CALIBRATION
from .dataset import DATASET

SCHEMAS = {"dataset": DATASET, "calibration": CALIBRATION}


def json_schema(name: str) -> str:
    """Return the JSON schema of `dataset.yaml` or `calibration.yaml`, by its name here."""
    content = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"{name}.yaml of smartview_jax",
        **SCHEMAS[name].json_schema(),
    }
    return json.dumps(content, indent=1) + "\n"


def shipped(name: str) -> Path:
    """Return where the schema is in the package."""
    return Path(__file__).with_name(f"{name}.schema.json")


if __name__ == "__main__":
    for file in SCHEMAS:
        write_atomically(shipped(file), json_schema(file))
