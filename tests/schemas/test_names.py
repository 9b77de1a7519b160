import dataclasses
from typing import get_args

import pytest

from smartview_jax.geometry import ANGLE_UNITS, LENGTH_UNITS
from smartview_jax.geometry.pose_codecs import EULER_CODECS, POSE_CODECS
from smartview_jax.robots.serial_arm import DH_CONVENTIONS
from smartview_jax.schemas import dataset
from smartview_jax.schemas.arm import ArmEntry
from smartview_jax.schemas.target import TargetEntry
from smartview_jax.schemas.validation import validate_content
from smartview_jax.targets.serialization import TARGET_CLASSES

KNOWN = {
    "codecs": (dataset.CodecName, (*POSE_CODECS, *EULER_CODECS)),
    "lengths": (dataset.LengthUnit, LENGTH_UNITS),
    "angles": (dataset.AngleUnit, ANGLE_UNITS),
    "conventions": (ArmEntry.model_fields["convention"].annotation, DH_CONVENTIONS),
}


@pytest.mark.parametrize("what", KNOWN)
def test_schemas_know_the_names_that_the_library_knows(what):
    literal, known = KNOWN[what]
    assert get_args(literal) == tuple(known)


def test_schemas_have_the_numbers_that_targets_have():
    union = get_args(get_args(TargetEntry)[0])
    entries = {get_args(entry.model_fields["kind"].annotation)[0]: entry for entry in union}
    assert set(entries) == set(TARGET_CLASSES)
    for kind, entry in entries.items():
        fields = {field.name: field for field in dataclasses.fields(TARGET_CLASSES[kind])}
        assert set(entry.model_fields) - {"kind", "heights", "file"} == set(fields)
        # The numbers of an AprilGrid may stand in a file of Kalibr's instead.
        in_file = "file" in entry.model_fields
        for name, field in fields.items():
            has_default = field.default is not dataclasses.MISSING
            assert entry.model_fields[name].is_required() != (has_default or in_file)
            assert not has_default or entry.model_fields[name].default == field.default


def test_no_more_problems_are_named_than_a_person_reads():
    from smartview_jax.schemas.dataset import DATASET_SCHEMA

    with pytest.raises(ValueError, match=r"^where: .*; and 2 more$") as caught:
        validate_content(
            {
                "smartview_dataset": 1,
                "camera": {"image_size": [0, 0]},
                "target": {"kind": "tag_grid", "rows": 0, "columns": 0, "size": 0},
                "poses": {"file": ""},
                "mount": "no",
            },
            DATASET_SCHEMA,
            "where",
        )
    assert len(str(caught.value)) < 1000
