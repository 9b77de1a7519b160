"""Read a calibration's file, or tell a person who gave something else which file to give."""

import os
from pathlib import Path
from typing import Any

from ..argument_checks import listed
from ..files import read_yaml

_KIND = "smartview_calibration"
"""The entry that every calibration's file has."""

_FIRST_BYTES = 500
"""Number of bytes in which the kind of a file is looked for: it is the first entry."""


def calibration_content(path: str | os.PathLike[str]) -> dict[Any, Any]:
    """Return the mapping in a calibration's file; its entries are not checked yet.

    Raises:
        FileNotFoundError: the file is missing, or is a folder; the message says which file to give.
        ValueError: the file has no mapping, or one without the kind of any file of this package.
    """
    place = Path(path)
    if place.is_dir():
        raise FileNotFoundError(
            f"{path}: is a folder, expected a file with a calibration{_file_to_give(place)}"
        )
    expected = "expected a calibration, such as calibration.yaml of smartview calibrate"
    try:
        content = read_yaml(path)
    except ValueError as error:
        raise ValueError(f"{error}; {expected}") from error
    if not any(str(key).startswith("smartview_") for key in content):
        raise ValueError(f"{path}: entry {_KIND!r} is missing; {expected}")
    return content


def _file_to_give(folder: Path) -> str:
    """Return words on the calibrations in a folder, or on how a data set gets one; may be empty."""
    calibrations = sorted(
        path for path in folder.glob("*.yaml") if path.is_file() and _has_calibration(path)
    )
    usual = folder / "calibration.yaml"
    if usual in calibrations:
        return f": give {usual}"
    if calibrations:
        names = [path.name for path in calibrations]
        return f": give one of {listed(names)} in it"
    if (folder / "dataset.yaml").is_file():
        return f": it has a data set; smartview calibrate {folder} --out RESULTS writes the file"
    return ""


def _has_calibration(path: Path) -> bool:
    """Return whether a file begins as a calibration's."""
    with path.open("rb") as file:
        return _KIND.encode() in file.read(_FIRST_BYTES)
