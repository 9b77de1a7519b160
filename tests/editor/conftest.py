import pytest
from editor_scene import drawn_scene
from sessions import open_session


@pytest.fixture(scope="module")
def scene():
    return drawn_scene()


@pytest.fixture
def session(scene, tmp_path):
    with open_session(scene, tmp_path / "house.json") as opened:
        yield opened
