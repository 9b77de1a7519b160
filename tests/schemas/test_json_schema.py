import json

import jsonschema
import pytest
import yaml
from typer.testing import CliRunner

from smartview_jax.cli import app
from smartview_jax.io import sample_folder
from smartview_jax.schemas.json_schema import SCHEMAS, json_schema, schema_path
from smartview_jax.simulation import paper_calibration


@pytest.mark.parametrize("name", SCHEMAS)
def test_what_ships_is_what_files_are_read_through(name):
    """If not: `python -m smartview_jax.schemas.json_schema`."""
    assert schema_path(name).read_text(encoding="utf-8") == json_schema(name)
    run = CliRunner().invoke(app, ["schema", name])
    assert json.loads(run.stdout) == json.loads(json_schema(name))


def test_an_editor_sees_what_the_library_sees(tmp_path):
    description = yaml.safe_load((sample_folder() / "dataset.yaml").read_text())
    jsonschema.validate(description, json.loads(json_schema("dataset")))
    for key, value in (("moutn", "eye_to_hand"), ("mount", "ceiling"), ("camera", {})):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**description, key: value}, json.loads(json_schema("dataset")))
    paper_calibration().save(tmp_path / "calibration.yaml")
    loaded = yaml.safe_load((tmp_path / "calibration.yaml").read_text())
    jsonschema.validate(loaded, json.loads(json_schema("calibration")))
    loaded["camera"]["alpha_u"] = -1.0
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(loaded, json.loads(json_schema("calibration")))
