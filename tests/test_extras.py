import sys

import pytest

from smartview_jax.extras import import_extra


def test_a_package_that_is_there_is_returned():
    assert import_extra("json.decoder", "objects", "this test").__name__ == "json.decoder"


def test_a_package_that_is_missing_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mapbox_earcut", None)
    said = r"^cutting faces needs mapbox-earcut: pip install 'smartview-jax\[objects\]'$"
    with pytest.raises(ImportError, match=said):
        import_extra("mapbox_earcut", "objects", "cutting faces")
