"""The page of a capture: who is let in, what it shows, what it does, and its stop button."""

import time

import pytest
from capture_scene import PATIENCE, everywhere, new_folder, wait_until
from chromium import Chromium, browser_or_skip
from served_pages import serve_in_thread

from smartview_jax.capture import serve_capture
from smartview_jax.capture.server import PAGE, CapturePage, capture_app

testclient = pytest.importorskip("starlette.testclient")

TOKEN, PORT = "a-token", 8124
ORIGIN = f"http://127.0.0.1:{PORT}"


@pytest.fixture
def session(tmp_path, rig):
    with rig.session(new_folder(tmp_path / "data"), goal=1e-3, motion=everywhere()) as session:
        yield session


@pytest.fixture
def page(session):
    with CapturePage(session) as page:
        yield page


@pytest.fixture
def client(page):
    return testclient.TestClient(capture_app(page, TOKEN, PORT), base_url=ORIGIN)


def let_in(client):
    assert client.get(f"/?token={TOKEN}").status_code == 200
    return {"origin": ORIGIN}


def test_only_the_page_itself_gets_pictures_and_moves_robots(client, session):
    for path in ("/", "/?token=b", "/status", "/picture"):
        assert client.get(path).status_code == 403
    assert client.post("/do", json={"do": "take"}, headers={"origin": ORIGIN}).status_code == 403
    own = let_in(client)
    for origin in (
        {},
        {"origin": "http://evil.example"},
        {"origin": f"http://127.0.0.1:{PORT + 1}"},
    ):
        assert client.post("/do", json={"do": "take"}, headers=origin).status_code == 403
    assert session.view_count == 0
    wrong_host = client.get("/status", headers={"host": "evil.example"})
    assert wrong_host.status_code == 400
    assert client.post("/do", content=b"x" * 20_000, headers=own).status_code == 413
    assert client.post("/do", content=b"{", headers=own).status_code == 400
    for message in ({"do": "ouija"}, {}, [], 7, {"do": []}):
        answer = client.post("/do", json=message, headers=own).json()
        assert not answer["ok"]
    assert client.post("/do", json={"do": "take"}, headers=own).json()["ok"]
    assert session.view_count == 1


def test_the_state_has_what_the_page_shows(client, session, rig):
    own = let_in(client)
    for rig.at in range(4):
        assert client.post("/do", json={"do": "take"}, headers=own).json()["ok"]
    assert session.wait_for_fit(PATIENCE)
    state = client.get("/status").json()
    assert (state["views"], state["fitted_views"]) == (4, 4)
    log = "\n".join(state["lines"])
    assert [log.count(f"view v{number} taken") for number in range(1, 5)] == [1] * 4
    assert state["error_mm"] == pytest.approx(2.25)
    assert state["target"]["count"] == len(state["target"]["points"]) > 90
    assert state["target"]["size"] == [640, 480]
    assert sum(map(sum, state["cells"])) > 5
    assert state["proposal"]["text"].startswith("x\N{NO-BREAK SPACE}0.")
    assert state["pose_units"] == "m"
    assert client.get("/picture").content.startswith(b"\xff\xd8")
    rig.camera_error = "unplugged"
    wait_until(lambda: client.get("/status").json()["troubles"] == ["camera: unplugged"])
    rig.camera_error = None
    wait_until(lambda: client.get("/status").json()["troubles"] == [])


def test_a_stop_ends_motion_and_automatic_run(client, session, rig):
    own = let_in(client)
    for rig.at in range(4):
        client.post("/do", json={"do": "take"}, headers=own)
    assert session.wait_for_fit(PATIENCE)
    rig.finish.clear()
    assert client.post("/do", json={"do": "run"}, headers=own).json()["ok"]
    assert rig.on_the_way.wait(PATIENCE)
    assert client.get("/status").json()["moving"]
    busy = client.post("/do", json={"do": "take"}, headers=own).json()
    assert busy == {"ok": False, "text": "an automatic run is going on: stop it first"}
    assert client.post("/do", json={"do": "stop"}, headers=own).json()["ok"]
    wait_until(lambda: not client.get("/status").json()["running"])
    assert rig.moved_to == []
    assert session.view_count == 4
    # Begun again by a person, it goes on to the goal.
    rig.finish.set()
    client.post("/do", json={"do": "run"}, headers=own)
    wait_until(lambda: client.get("/status").json()["reached"])
    wait_until(lambda: not client.get("/status").json()["running"])
    assert "stop: 1 mm reached" in client.get("/status").json()["lines"][-1]
    assert client.get("/status").json()["proposal"] is None


def test_pictures_are_taken_only_while_a_page_is_open(client, session, rig, monkeypatch):
    let_in(client)
    time.sleep(0.5)
    assert session.last_look is None
    client.get("/status")
    wait_until(lambda: session.last_look is not None)


def test_everything_that_the_page_loads_is_in_the_package():
    assert {path.name for path in PAGE.iterdir()} == {"index.html", "style.css", "capture.js"}
    text = "".join(path.read_text() for path in PAGE.iterdir())
    assert "https://" not in text
    assert "http://" not in text


def test_the_page_in_a_browser(tmp_path, rig):
    """A person takes views, sees the error fall, and reads the page on a phone."""
    playwright, path = browser_or_skip()
    chromium = Chromium(playwright, path)
    folder = new_folder(tmp_path / "data")
    try:
        with rig.session(folder, goal=2e-3, motion=everywhere()) as session:
            faults = []
            address = serve_in_thread(serve_capture, session, 0)
            window = chromium.running().new_page(viewport={"width": 390, "height": 844})
            window.on("pageerror", lambda error: faults.append(str(error)))
            window.goto(address)
            for rig.at in range(5):
                window.wait_for_function("!document.querySelector('#take').disabled")
                window.click("#take")
                words = f"view v{1 + rig.at} taken"
                window.wait_for_function(
                    f"document.querySelector('#said').textContent === '{words}'"
                )
            window.wait_for_function("document.querySelector('#error').textContent === '1.8 mm'")
            assert window.evaluate("document.documentElement.scrollWidth") == 390
            window.set_viewport_size({"width": 1400, "height": 900})
            assert window.locator("#goal").bounding_box()["height"] < 24
            window.click("#move")
            window.wait_for_function("/moved/.test(document.querySelector('#said').textContent)")
            window.keyboard.press("Escape")
            window.wait_for_function("document.querySelector('#said').textContent === 'stopped'")
            assert session.is_stopped
            assert faults == []
            window.close()
    finally:
        chromium.close()
        playwright.stop()
