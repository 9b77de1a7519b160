import functools

import pytest
from chromium import Chromium, browser_or_skip
from editor_scene import drawn_scene
from sessions import open_session

from smartview_jax.editor import kept_results


@pytest.fixture(scope="session")
def scene():
    """The drawn house: nothing of it is changed."""
    return drawn_scene()


@pytest.fixture
def session(scene, tmp_path):
    with open_session(scene, tmp_path / "house.json") as opened:
        yield opened


@pytest.fixture(scope="module")
def chromium():
    """One browser for a file's tests; what each of them opens is apart from the others' in it."""
    playwright, path = browser_or_skip()
    browser = Chromium(playwright, path)
    yield browser
    browser.close()
    playwright.stop()


_find, _found = kept_results.find_features, {}


@functools.wraps(_find)
def _find_once(picture, camera):
    key = picture.shape, picture.tobytes(), float(camera.alpha_u), float(camera.u0)
    if key not in _found:
        _found[key] = _find(picture, camera)
    return _found[key]


@pytest.fixture(autouse=True, scope="module")
def _features_are_found_once():
    """Many sessions show the same pictures, whose features are not what these tests are about."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kept_results, "find_features", _find_once)
        yield
