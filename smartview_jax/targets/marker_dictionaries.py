"""List the marker dictionaries by name, with the number of markers in each."""

from ..argument_checks import require_one_of

MARKER_COUNTS: dict[str, int] = {
    **{
        f"DICT_{bits}X{bits}_{count}": count
        for bits in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    },
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}
"""Number of markers in each dictionary, by OpenCV's name for the dictionary.

OpenCV also has the pictures of the markers.
"""


def require_markers(dictionary: str, last_id: int) -> None:
    """Raise a ValueError unless the dictionary exists and contains the marker with this number."""
    require_one_of("dictionary", dictionary, MARKER_COUNTS)
    count = MARKER_COUNTS[dictionary]
    if last_id >= count:
        raise ValueError(
            f"dictionary: {dictionary} has {count} markers, 0 to {count - 1}; "
            f"the target needs marker {last_id}"
        )
