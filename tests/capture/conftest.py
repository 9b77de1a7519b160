import pytest
from capture_scene import Rig, quick_fit


@pytest.fixture
def rig(monkeypatch):
    """A rig in whose sessions a fit takes no time."""
    rig = Rig()
    monkeypatch.setattr("smartview_jax.capture.session.estimate", quick_fit(rig))
    return rig
