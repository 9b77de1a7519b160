"""Real data sets that lie beside the checkout; tests that need one skip where it is missing."""

from pathlib import Path

import pytest

_ROOT = Path(__file__).resolve().parents[2] / "shared" / "data"


def shared_data(name: str) -> Path:
    """Folder of one data set; skips the test, with the reason, where it is missing."""
    folder = _ROOT / name
    if not folder.is_dir():
        pytest.skip(f"the data set {name} is not beside this checkout (shared/data/{name})")
    return folder
