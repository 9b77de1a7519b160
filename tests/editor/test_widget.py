"""The notebook's widget: its script runs in a browser as Jupyter would run it."""

import base64
import json

import pytest
from browser import PATIENCE

from smartview_jax.editor import ModelSession, editor_widget
from smartview_jax.editor.widget import widget_script

HOST_PAGE = """
async (script) => {
    const address = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
    const widget = (await import(address)).default;
    const handlers = [];
    window.receive = (answer, data) => {
        const bytes = data && Uint8Array.from(atob(data), (c) => c.charCodeAt(0));
        for (const one of handlers) one(answer, bytes ? [new DataView(bytes.buffer)] : []);
    };
    const model = {
        send: (message) => window.toKernel(JSON.stringify(message)),
        on: (name, handler) => handlers.push(handler),
        off: () => {},
    };
    await widget.render({ model, el: document.body });
}
"""


@pytest.fixture
def widget(scene, monkeypatch):
    pytest.importorskip("anywidget")
    session = ModelSession(scene.calibration, scene.base_from_tool, scene.pictures)
    widget = editor_widget(session)
    sent = []
    monkeypatch.setattr(
        widget, "send", lambda answer, buffers=None: sent.append((answer, buffers)), raising=False
    )
    return session, widget, sent


def test_messages_of_a_notebook_are_answered(widget):
    session, shown, sent = widget
    shown._answer({"do": "hello", "message": 1})
    assert sent[-1][0]["reply_to"] == 1
    assert [view["name"] for view in sent[-1][0]["views"]] == session.names
    shown._answer({"do": "picture", "view": "v2", "message": 2})
    answer, (data,) = sent[-1]
    assert answer["view"] == "v2"
    assert data.startswith(b"\xff\xd8")
    shown._answer({"do": "add_point", "clicks": {"v1": [3.0, 4.0]}, "message": 3})
    assert session.document.points == {0: {"v1": (3.0, 4.0)}}
    session.click("v2", (5.0, 6.0))
    shown.refresh()
    assert list(sent[-1][0]["parts"]["points"]) == [1]


def test_the_script_needs_no_network_and_draws(widget, chromium):
    _, shown, sent = widget
    page = chromium.running().new_page(viewport={"width": 1300, "height": 800})
    requests, queue = [], []
    page.on("request", lambda request: requests.append(request.url))
    page.expose_function("toKernel", lambda text: queue.append(json.loads(text)))
    page.goto("about:blank")
    page.evaluate(HOST_PAGE, widget_script())
    complete = "window.smartviewEditor?.complete === true"
    for _ in range(PATIENCE // 50):
        while queue:
            shown._answer(queue.pop(0))
            answer, buffers = sent[-1]
            data = base64.b64encode(buffers[0]).decode() if buffers else None
            page.evaluate("([answer, data]) => receive(answer, data)", [answer, data])
        if page.evaluate(complete):
            break
        page.wait_for_timeout(50)
    assert page.evaluate(complete)
    assert page.evaluate("smartviewEditor.views.every((view) => view.levels.length > 0)")
    assert all(url.startswith(("blob:", "about:", "data:")) for url in requests), requests
    page.close()
