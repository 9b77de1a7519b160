"""Test that values that no camera, covariance or pose file can have are refused with words."""

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from smartview_jax.schemas.calibrated_rig import RELATIVE_POSE_SCHEMA
from smartview_jax.schemas.calibration import PinholeEntry, UncertaintyEntry
from smartview_jax.schemas.external_formats import VISP_CAMERA_SCHEMA, VISP_POSE_SCHEMA
from smartview_jax.targets import TagGrid
from smartview_jax.targets.serialization import target_from_dict, target_to_dict

VISP = {"image_width": 640, "image_height": 480, "u0": 320.0, "v0": 240.0}
REST = {"pixel_sigma": 0.1, "smallest_singular_value": 1.0}


def uncertainty(matrix, names=("a", "b", "c")):
    content = {"parameters": list(names), "covariance": matrix, **REST}
    return TypeAdapter(UncertaintyEntry).validate_python(content)


def test_a_covariance_with_a_negative_direction_is_refused():
    """Each pair of parameters is possible (correlation -0.9), all three together are not."""
    r = -0.9
    with pytest.raises(ValidationError, match="not positive semidefinite"):
        uncertainty([[1.0, r, r], [r, 1.0, r], [r, r, 1.0]])
    assert uncertainty([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1e-12]])


def test_an_infinite_variance_has_no_covariances():
    matrix = np.eye(6).tolist()
    matrix[2][2] = None
    kind = "smartview_relative_pose"
    transform = {"quaternion_wxyz": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 1.0]}
    content = {kind: 1, "first_from_second": transform, "covariance": matrix, "end": kind}
    assert RELATIVE_POSE_SCHEMA.validate_python(content)
    matrix[2][4] = matrix[4][2] = 0.5
    with pytest.raises(ValidationError, match="expected zeros next to an infinite variance"):
        RELATIVE_POSE_SCHEMA.validate_python(content)


def test_a_parameter_that_comes_twice_is_named():
    with pytest.raises(ValidationError, match="b occurs twice"):
        uncertainty([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], ("a", "b", "b"))


def test_pixels_have_a_sensors_shape():
    with pytest.raises(ValidationError, match="expected at most 10 times"):
        VISP_CAMERA_SCHEMA.validate_python({**VISP, "px": 600.0, "py": 0.6e6})
    with pytest.raises(ValidationError, match="expected at most 10 times"):
        TypeAdapter(PinholeEntry).validate_python(
            {"alpha_u": 6e5, "alpha_v": 600.0, "u0": 320.0, "v0": 240.0}
        )
    with pytest.raises(ValidationError, match="from 1 to 1e7"):
        VISP_CAMERA_SCHEMA.validate_python({**VISP, "px": 5e-324, "py": 600.0})


def test_unknown_entries_of_a_visp_pose_are_refused():
    data = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0]
    assert VISP_POSE_SCHEMA.validate_python({"rows": 6, "cols": 1, "data": data}).data == data
    with pytest.raises(ValidationError, match="no entry is called"):
        VISP_POSE_SCHEMA.validate_python({"data": data, "unit": "mm"})


@pytest.mark.parametrize("gap", [{}, {"gap": 0.0}, {"gap": None}])
def test_a_grid_of_tags_needs_a_gap_and_a_single_tag_none(gap):
    with pytest.raises(ValueError, match="a grid of 2 x 3 tags needs the distance between"):
        TagGrid(2, 3, 0.04, **gap)
    single = TagGrid(1, 1, 0.04, **gap)
    assert target_from_dict(target_to_dict(single)) == single
    np.testing.assert_array_equal(single.points, TagGrid(1, 1, 0.04, 0.01).points)
