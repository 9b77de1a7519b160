"""Files of another kind are named as such, whatever else they lack."""

import pytest

from smartview_jax.schemas import CALIBRATION_SCHEMA, validate_content


@pytest.mark.parametrize("kind", ["smartview_rig", "smartview_dataset"])
def test_a_file_of_another_kind_is_named(kind):
    expected = f"a file of the kind smartview_calibration is expected, found {kind}"
    with pytest.raises(ValueError, match=expected):
        validate_content({kind: 1, "cameras": {}}, CALIBRATION_SCHEMA)


def test_a_calibration_without_its_mount_is_no_other_file():
    with pytest.raises(ValueError, match="entry 'mount' is missing"):
        validate_content({"smartview_calibration": 1}, CALIBRATION_SCHEMA)
