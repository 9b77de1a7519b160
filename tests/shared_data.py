"""Real data sets that lie next to the checkout; tests that need one skip where it is missing."""

import json
from pathlib import Path

import pytest

from smartview_jax.dataset import Dataset
from smartview_jax.io import import_correspondences

_SHARED = Path(__file__).resolve().parents[2] / "shared"
_ROOT = _SHARED / "data"


def shared_data(name: str) -> Path:
    """Folder of one data set; skips the test, with the reason, where it is missing."""
    folder = _ROOT / name
    if not folder.is_dir():
        pytest.skip(f"the data set {name} is not next to this checkout (shared/data/{name})")
    return folder


def shared_pairs(name: str, prefix: str = "") -> tuple[Dataset, dict]:
    """A data set's corners and poses, and its reference figures."""
    folder = shared_data(name)
    reference = json.loads((folder / f"{prefix}measured.json").read_text())
    data = import_correspondences(
        folder / f"{prefix}poses.csv",
        folder / f"{prefix}corners.csv",
        tuple(reference["image_size"]),
        mount="eye_in_hand" if reference["eye_in_hand"] else "eye_to_hand",
    )
    return data, reference


def shared_case(name: str) -> Path:
    """File or folder of one small case; skips the test, with the reason, where it is missing."""
    path = _SHARED / "cases" / name
    if not path.exists():
        pytest.skip(f"the case {name} is not next to this checkout (shared/cases/{name})")
    return path
