"""Who is let in: this machine, with the token, from the page itself."""

import asyncio
import threading
import time

import pytest

from smartview_jax.editor import ModelSession
from smartview_jax.editor.server import HOST, PAGE, editor_app, serve

testclient = pytest.importorskip("starlette.testclient")
websockets = pytest.importorskip("starlette.websockets")

TOKEN, PORT = "a-token", 8123
ORIGIN = f"http://{HOST}:{PORT}"


@pytest.fixture(scope="module")
def session(scene):
    return ModelSession(scene.calibration, scene.base_from_tool, scene.pictures)


@pytest.fixture
def client(session):
    app = editor_app(session, TOKEN, PORT)
    # The test client's own portal is deprecated by a library below it, not by this package.
    return testclient.TestClient(app, base_url=ORIGIN)


def refused(client, **how):
    with (
        pytest.raises(websockets.WebSocketDisconnect) as caught,
        client.websocket_connect("/socket", **how),
    ):
        pass
    assert caught.value.code == 1008


def test_the_page_needs_the_token(client):
    assert client.get("/").status_code == 403
    assert client.get("/?token=a-toke").status_code == 403
    page = client.get(f"/?token={TOKEN}")
    assert page.status_code == 200
    assert "samesite=strict" in page.headers["set-cookie"].lower()
    assert "httponly" in page.headers["set-cookie"].lower()


def test_pictures_need_the_token(client):
    assert client.get("/picture/v1").status_code == 403
    client.cookies.set(f"smartview_editor_{PORT}", TOKEN)
    assert client.get("/picture/v1").content.startswith(b"\xff\xd8")
    assert client.get("/picture/v9").status_code == 404
    assert client.get("/picture/..%2Fserver.py").status_code == 404
    assert client.get("/../server.py").status_code == 404


def test_another_name_of_this_machine_is_refused(client):
    """A page that makes its own name lead here would otherwise pass for this one."""
    assert client.get(f"/?token={TOKEN}", headers={"host": "evil.example"}).status_code == 400


def test_the_socket_needs_the_token_and_the_pages_origin(client):
    host = {"host": f"{HOST}:{PORT}"}
    good = {"origin": ORIGIN, **host}
    refused(client, headers=good)
    client.cookies.set(f"smartview_editor_{PORT}", TOKEN)
    refused(client, headers=host)
    refused(client, headers={"origin": "http://evil.example", **host})
    refused(client, headers={"origin": f"http://{HOST}:{PORT + 1}", **host})
    with client.websocket_connect("/socket", headers=good) as socket:
        socket.send_json({"do": "hello", "message": 7})
        answer = socket.receive_json()
        assert (answer["type"], answer["reply_to"]) == ("greeting", 7)
        socket.send_json({"do": "add_point", "clicks": {"v1": [1e9, 0.0]}, "message": 8})
        answer = socket.receive_json()
        assert (answer["type"], answer["reply_to"]) == ("error", 8)
        assert "outside the picture" in answer["text"]
        socket.send_json({"do": "hover", "view": "v1", "pixel": [100.0, 100.0], "message": 9})
        assert set(socket.receive_json()["curves"]) == {"v2", "v3", "v4", "v5"}


def test_a_port_in_use_is_named(session):
    import socket

    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"port {port} of 127.0.0.1"):
            serve(session, port)


def test_what_is_prepared_ends_with_the_server(session, monkeypatch):
    """A thread that still computed when Python ended would abort the process."""
    import uvicorn

    ended = []

    def prepare(stop):
        assert stop.wait(timeout=60.0)
        time.sleep(0.2)
        ended.append(True)

    monkeypatch.setattr(session, "prepare", prepare)
    monkeypatch.setattr(uvicorn.Server, "run", lambda *_: None)
    serve(session)
    assert ended == [True]


def test_preparing_stops_between_pictures(session, monkeypatch):
    stop, looked_at = threading.Event(), []

    def features(name):
        looked_at.append(name)
        stop.set()

    monkeypatch.setattr(session, "features", features)
    session.prepare(stop)
    assert looked_at == [session.names[0]]


def test_everything_that_the_page_loads_is_in_the_package():
    names = {path.name for path in PAGE.rglob("*") if path.is_file()}
    assert {"index.html", "style.css", "editor.js", "three.LICENSE"} <= names
    text = "".join(
        path.read_text() for path in PAGE.iterdir() if path.suffix in (".js", ".html", ".css")
    )
    assert "https://" not in text
    assert "MIT" in (PAGE / "vendor" / "three.LICENSE").read_text()


class FakePage:
    """A socket that keeps what is sent to it, fails, or never takes anything."""

    def __init__(self, error=None, reads=True):
        self.error, self.reads, self.told, self.closed = error, reads, [], None

    async def send_json(self, message):
        if self.error is not None:
            raise self.error
        if not self.reads:
            await asyncio.Event().wait()
        self.told.append(message["type"])

    async def close(self, code):
        self.closed = code


async def told(session, pages, update):
    """Tell pages of a change, with a function for each that makes its update."""
    from smartview_jax.editor import server

    editor = server._Editor(session, server.PageAccess(TOKEN, PORT, "editor"))
    tasks = []
    for page in pages:
        shown = server._Page(server.Conversation(session), asyncio.Event())
        shown.conversation.update = lambda page=page: update(page)
        editor._pages[page] = shown
        tasks.append(asyncio.create_task(editor._tell(page, shown)))
    editor._note_change(None)
    for _ in range(500):
        if pages[-1].told:
            break
        await asyncio.sleep(0.01)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def test_no_page_keeps_another_from_its_update(session):
    """One has left, one never reads, and the update of one fails; the last is told all the same."""
    gone = FakePage(error=websockets.WebSocketDisconnect(1006))
    deaf, broken, page = FakePage(reads=False), FakePage(), FakePage()

    def update(of):
        if of is broken:
            raise ZeroDivisionError("by zero")
        return {"type": "update"}

    asyncio.run(told(session, [gone, deaf, broken, page], update))
    assert page.told == ["update"]
    # It connects again, and is greeted.
    assert broken.closed == 1011


def test_two_editors_of_one_browser_have_a_cookie_each(session):
    names = set()
    for port in (PORT, PORT + 1):
        app = editor_app(session, TOKEN, port)
        page = testclient.TestClient(app, base_url=f"http://{HOST}:{port}").get(f"/?token={TOKEN}")
        names.add(page.headers["set-cookie"].partition("=")[0])
    assert len(names) == 2
