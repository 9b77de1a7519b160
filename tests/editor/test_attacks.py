"""A real server under attack: by other pages, other programs, and a page that sends anything."""

import asyncio
import contextlib
import functools
import http.client
import http.server
import json
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from http.cookies import SimpleCookie
from urllib.parse import parse_qs, urlsplit

import pytest
from browser import Page, serve_in_thread
from sessions import open_session

websockets = pytest.importorskip("websockets", reason="the editor's server is not installed")

PATIENCE = 60.0
"""Longest wait for anything, s."""

RUNS = "window.ran=(window.ran||0)+1"
"""What would run in the page if a name were taken for HTML."""

NAMES = (
    f"<script>{RUNS}</script>",
    f"<img src=x onerror={RUNS}>",
    f'"><svg onload={RUNS}>',
    f"' onfocus='{RUNS}' autofocus='",
    "<!--<script>",
)
"""Names of the views; objects, faces, grasps and files have them, too."""


def waited(awaitable):
    """What an awaitable gives; in a thread of its own, as the browser's loop has this one."""

    async def limited():
        return await asyncio.wait_for(awaitable, PATIENCE)

    with ThreadPoolExecutor(1) as threads:
        return threads.submit(asyncio.run, limited()).result()


class Target:
    """A served session, with its address, its token and where its document was."""

    def __init__(self, session):
        self.session, self.before = session, session.document
        self.address = serve_in_thread(session)
        parts = urlsplit(self.address)
        self.port, self.token = parts.port, parse_qs(parts.query)["token"][0]
        self.origin = f"http://127.0.0.1:{self.port}"
        status, headers, _ = self.get(f"/?token={self.token}")
        assert status == 200
        self.cookie = headers["set-cookie"].split(";")[0]

    def get(self, path, method="GET", body=None, **headers):
        """Ask for a path exactly as it is written; return status, headers and content.

        The status is None where the server hung up.
        """
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        connection.putrequest(method, path, skip_host="host" in headers)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        if body is not None:
            connection.putheader("content-length", str(len(body)))
        # The server may answer, and hang up, before it was told everything.
        with contextlib.suppress(OSError):
            connection.endheaders(body)
        try:
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        except OSError:
            return None, {}, b""
        finally:
            connection.close()

    def socket(self, **given):
        """A connection as the page makes it, unless something else is given."""
        headers = {"cookie": given.pop("cookie", self.cookie)}
        how = {"origin": self.origin, "additional_headers": headers, "max_size": None, **given}
        return websockets.connect(f"ws://127.0.0.1:{self.port}/socket", **how)


@pytest.fixture(scope="module")
def target(scene, tmp_path_factory):
    """A face with a grasp, drawn in views whose names are HTML."""
    path = tmp_path_factory.mktemp("attacked") / f"<img src=x onerror={RUNS}>.json"
    with open_session(scene, path, names=NAMES) as session:
        loop = scene.truth.faces[4].loop
        clicks = [
            {name: list(scene.click(k, vertex)) for k, name in enumerate(NAMES)} for vertex in loop
        ]
        session.change(
            {"do": "several", "changes": [{"do": "add_point", "clicks": click} for click in clicks]}
        )
        face = session.add_face(sorted(session.document.points), name=NAMES[1], graspable=True)
        session.add_grasp(face, name=NAMES[0], opening=0.2)
        session.change({"do": "rename", "name": NAMES[2]})
        yield Target(session)
    # Whatever was tried before, the file opens again and has the same document.
    with open_session(scene, path, names=NAMES) as session:
        assert session.document.points
        session.save()


@pytest.fixture(autouse=True)
def _still_serves(target):
    """After each attack the server answers, and what was drawn is as it was."""
    yield
    status, _, content = target.get("/editor.js")
    assert status == 200
    assert content
    assert target.session.document is target.before
    answer = waited(asked(target, {"do": "hello", "message": 1}))
    assert answer["type"] == "greeting"


async def asked(target, message):
    async with target.socket() as page:
        await page.send(json.dumps(message))
        return json.loads(await page.recv())


def test_requests_under_foreign_names_and_tokens_are_refused(target):
    host = f"evil.example:{target.port}"
    assert target.get(f"/?token={target.token}", host=host)[0] == 400
    assert target.get("/picture/x", host="127.0.0.1.evil.example", cookie=target.cookie)[0] == 400
    for token in ("", "x", target.token[:-1], target.token + "x", "%00", "%FF%FE", "x" * 5000):
        assert target.get(f"/?token={token}")[0] == 403
    assert target.get("/")[0] == 403
    name = SimpleCookie(target.cookie)
    (key,) = name
    others = (
        "",
        f"smartview_editor_{target.port + 1}={target.token}",
        f"{key}=x",
        f"{key}=",
        f"{key}={target.token}x",
        "a/b=c; =; ;; \xff=\xff",
    )
    for cookie in others:
        assert target.get("/picture/x", cookie=cookie)[0] == 403


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "XYZ"])
def test_nothing_but_get_is_answered(target, method):
    for path in ("/", "/socket", "/picture/x", "/editor.js"):
        status, _, content = target.get(path, method, b"do=rename", cookie=target.cookie)
        assert status in (403, 404, 405), path
        assert b"token" not in content


PATHS = (
    *("/../server.py", "/..%2fserver.py", "/%2e%2e/server.py", "/%2e%2e%2fserver.py"),
    *("/%252e%252e%252fserver.py", "/..\\server.py", "/..%5cserver.py", "/vendor/../../server.py"),
    *("//etc/passwd", "/%2fetc/passwd", "/picture/../../server.py", "/picture/..%2f..%2fserver.py"),
    *("/picture/%2e%2e%2fserver.py", "/picture//etc/passwd", "/editor.js%00.png", "/.", "/vendor"),
    *("/C:%5cWindows%5cwin.ini", "/....//server.py", "/%c0%ae%c0%ae/server.py", "/" + "a" * 5000),
)


def test_no_path_leads_out_of_the_pages_folder(target):
    for path in PATHS:
        status, _, content = target.get(path, cookie=target.cookie)
        assert status in (400, 403, 404, 405, 414), path
        assert b"import" not in content
        assert b"root:" not in content


def test_a_view_with_a_slash_in_its_name_is_shown(target):
    """Pictures in folders have such names; `</script>` has one, too."""
    path = "/picture/" + "".join(f"%{byte:02X}" for byte in NAMES[0].encode())
    status, _, content = target.get(path, cookie=target.cookie)
    assert status == 200
    assert content.startswith(b"\xff\xd8")


def test_huge_requests_end(target):
    assert target.get("/", "POST", b"x" * 20_000_000)[0] in (405, None)
    assert target.get("/", cookie="a=" + "x" * 1_000_000)[0] in (400, 403, 431, None)


async def refused(target, **how):
    try:
        async with target.socket(**how):
            return False
    except websockets.exceptions.InvalidStatus as error:
        return error.response.status_code == 403


async def strangers(target):
    for origin in (None, "null", "http://evil.example", f"https://127.0.0.1:{target.port}"):
        assert await refused(target, origin=origin), origin
    assert await refused(target, origin=f"http://127.0.0.1:{target.port + 1}")
    assert await refused(target, cookie="")
    assert await refused(target, cookie=f"smartview_editor_{target.port + 1}={target.token}")
    # A cookie of another program with a key that is none keeps nobody out, and lets nobody in.
    assert await refused(target, cookie="a/b=c")
    async with target.socket(cookie=f"a/b=c; {target.cookie}") as page:
        await page.send('{"do": "hello", "message": 1}')
        assert "greeting" in await page.recv()


def test_sockets_of_strangers_are_refused(target):
    waited(strangers(target))


MESSAGES = (
    *({}, {"do": None}, {"do": "fly"}, {"do": "__class__"}, {"do": ["hello"]}, {"do": {"a": 1}}),
    *({"do": "hello", "x": 1}, {"do": "hover", "self": 1}, {"do": "hover", "view": "__proto__"}),
    {"do": "__proto__", "__proto__": {"do": "delete"}},
    {"do": "change_face", "id": 4, "__proto__": {"name": "x"}},
    {"do": "change_face", "id": 4, "loop": ["__proto__"]},
    {"do": "change_face", "id": 2**70, "name": "x"},
    {"do": "add_edge", "ends": [2**70, 0]},
    {"do": "add_edge", "ends": [0, float("inf")]},
    {"do": "add_edge", "ends": [0.5, 1.5]},
    {"do": "add_point", "clicks": {NAMES[0]: [float("nan"), 1.0]}},
    {"do": "add_point", "clicks": {NAMES[0]: [float("inf"), 1.0]}},
    {"do": "add_point", "clicks": {NAMES[0]: [2**70, 1.0]}},
    {"do": "add_point", "clicks": {"__proto__": [1.0, 1.0]}},
    {"do": "click", "point": 0, "view": NAMES[1], "pixel": {"__proto__": 1}},
    {"do": "delete", "kind": "__class__", "id": 0},
    {"do": "delete", "kind": "points", "id": [0]},
    {"do": "delete", "kind": "points", "id": -1},
    {"do": "rename", "name": "\ud800"},
    {"do": "rename", "name": "\u202e"},
    {"do": "rename", "name": "x" * 1_000_000},
    {"do": "rename", "name": {"toString": 1}},
    {"do": "change_grasp", "id": 9, "face": 99},
    {"do": "grasp_at", "view": NAMES[0], "pixel": [1, 1], "depth": float("nan")},
    {"do": "several", "changes": [{"do": "delete", "kind": "points", "id": 0}, {"do": "fly"}]},
    {"do": "accept", "points": [2**70]},
    {"do": "propose", "rectangles": {NAMES[0]: [0, 0, float("nan"), 2**70]}},
    {"do": "features", "view": "../../etc/passwd"},
    functools.reduce(lambda inner, _: {"do": "several", "changes": [inner]}, range(300), {}),
)
"""Messages in JSON that no page sends; each is answered by an error."""

NO_MESSAGES = (
    *("", "x", "[]", "[1]", "1", "null", '"hello"', "{", '{"do": "hello"', "NaN", "1e999"),
    *("[" * 100_000, "9" * 10_000, '{"do": "rename", "name": ' + "[" * 5000, b"\xff\xfe", b"{}"),
    *(b'{"do": "hello"}', "x" * 20_000_000),
)
"""What is no message at all; it ends its socket, and no other."""


async def wrong_messages(target):
    async with target.socket() as page:
        for number, message in enumerate(MESSAGES):
            await page.send(json.dumps({**message, "message": number}))
            answer = json.loads(await page.recv())
            assert answer["type"] == "error", (message, answer)
            assert answer["reply_to"] == number
            assert answer["text"]
        # NaN and 1e999 as JavaScript's numbers do not come; as text they may.
        await page.send('{"do": "click", "point": 0, "view": "v", "pixel": [NaN, 1e999]}')
        assert json.loads(await page.recv())["type"] == "error"
    for content in NO_MESSAGES:
        async with target.socket() as page:
            try:
                await page.send(content)
                answer = await page.recv()
            except websockets.exceptions.ConnectionClosed:
                continue
            assert json.loads(answer)["type"] == "error", content[:60]


def test_wrong_messages_are_errors_and_end_one_socket_at_most(target, caplog):
    waited(wrong_messages(target))
    assert not [record for record in caplog.records if "Exception" in record.message]


TOO_MANY = 12
"""Messages whose answers, 1 MB each, do not fit into the buffers between server and page."""

UNTIL_FULL = 1.0
"""Time until these buffers are full, s."""


async def answered(page, number):
    """Wait for an answer between the updates that others cause."""
    while json.loads(await page.recv()).get("reply_to") != number:
        pass


async def flood(target):
    """A page that never reads, one that sends without end, and one that works meanwhile."""
    # With little room for what it does not read.
    small = socket.create_connection(("127.0.0.1", target.port))
    small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    async with (
        target.socket(sock=small, ping_interval=None, compression=None) as deaf,
        target.socket() as eager,
    ):
        try:
            await overrun(target, deaf, eager)
        finally:
            # Neither of them would answer a farewell.
            eager.transport.abort()
            deaf.transport.abort()


async def overrun(target, deaf, eager):
    """Send on two sockets what nobody reads, and work on two others."""
    deaf.transport.pause_reading()
    # The server may stop to take what such a page sends.
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(UNTIL_FULL):
            for _ in range(TOO_MANY):
                # What the page gives as a number comes back with the answer.
                await deaf.send(json.dumps({"do": "hello", "message": "x" * 1_000_000}))
            await asyncio.sleep(UNTIL_FULL)
    for _ in range(200):
        await eager.send('{"do": "features", "view": "v", "message": 1}')
    async with target.socket() as one, target.socket() as other:
        for number in range(5):
            # Others are told of each change; these two do not listen.
            for page, change in (
                (one, {"do": "rename", "name": "x"}),
                (other, {"do": "undo"}),
            ):
                await page.send(json.dumps({**change, "message": number}))
                await answered(page, number)


def test_a_flood_and_a_page_that_never_reads_stop_nobody(target):
    waited(flood(target))


HOSTILE = """<!doctype html><form id="f" method="post" action="{origin}/?token=x" target="i">
<input name="do" value="rename"></form><iframe name="i"></iframe>
<img src="{origin}/picture/x"><script src="{origin}/socket"></script><script>
window.seen = [];
const note = (word) => window.seen.push(word);
document.getElementById("f").submit();
const socket = new WebSocket("ws://127.0.0.1:{port}/socket");
socket.onopen = () => note("open");
socket.onmessage = () => note("message");
const closed = new Promise((done) => {{ socket.onclose = done; }});
const read = fetch("{origin}/picture/x", {{ credentials: "include" }})
  .then((answer) => answer.text()).then(() => note("read")).catch(() => null);
const page = fetch("{origin}/", {{ credentials: "include" }})
  .then((answer) => answer.text()).then(() => note("page")).catch(() => null);
Promise.all([closed, read, page]).then(() => {{ window.tried = true; }});
</script>"""


@contextlib.contextmanager
def hostile_page(target):
    """The address of a page of another origin, on the same machine and in the same browser."""
    content = HOSTILE.format(origin=target.origin, port=target.port).encode()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("content-type", "text/html")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def test_names_do_not_run_and_other_pages_get_nothing(target, chromium):
    dialogs = []
    with Page(chromium, target.address) as page:
        page.page.on("dialog", lambda dialog: (dialogs.append(dialog.message), dialog.dismiss()))
        assert page.counts() == [4, 4, 1, 1]
        # The details of each part, and errors with names in them.
        for kind in ("points", "edges", "faces", "grasps"):
            page.page.evaluate(
                """(kind) => {
                    const [id] = smartviewEditor.model[kind].keys();
                    smartviewEditor.selection = new Set([`${kind}:${id}`]);
                    smartviewEditor.refresh();
                }""",
                kind,
            )
            page.settle()
        for name in NAMES:
            change = {"do": "click", "point": 0, "view": f"{name}?", "pixel": [1, 1]}
            page.page.evaluate("(change) => smartviewEditor.change(change)", change)
            assert name in page.said()
        names = page.page.evaluate("smartviewEditor.views.map((view) => view.element.innerText)")
        assert all(name in text for name, text in zip(NAMES, names, strict=True))
        # In the same browser, which has the cookie.
        with hostile_page(target) as address:
            other = page.context.new_page()
            other.goto(address)
            other.wait_for_function("window.tried === true", timeout=1e3 * PATIENCE)
            assert other.evaluate("window.seen") == []
            other.close()
        assert page.page.evaluate("window.ran") is None
        assert dialogs == []
        assert page.faults == []
