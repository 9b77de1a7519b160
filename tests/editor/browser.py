"""The editor's page in a real browser, driven as a person would: by the mouse and by keys."""

import contextlib
import os
import subprocess
import sys

import served_pages

from smartview_jax.editor import serve

PATIENCE = 60_000
"""Longest wait for the page, ms: a loaded machine compiles slowly."""


def serve_in_thread(session, port=0):
    """The address of the editor's page, served by this process."""
    return served_pages.serve_in_thread(serve, session, port)


class Page:
    """A page of the editor, with what a person does on it."""

    def __init__(self, chromium, address, size=(1500, 900)):
        viewport = dict(zip(("width", "height"), size, strict=True))
        self.context = chromium.running().new_context(viewport=viewport)
        self.page = self.context.new_page()
        self.faults = []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.goto(address)
        self.wait_until_complete()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        """Close the page, which would otherwise be drawn again at each change."""
        # A browser that was made to crash has closed it already.
        if self.context.browser.is_connected():
            self.context.close()

    def wait_until_complete(self):
        self.page.wait_for_function("window.smartviewEditor?.complete", timeout=PATIENCE)

    def place(self, view, pixel):
        """Where a pixel of a view is on the screen."""
        return self.page.evaluate(
            """([k, pixel]) => {
                const view = smartviewEditor.views[k], box = view.element.getBoundingClientRect();
                const [x, y] = view.toScreen(pixel);
                return [x + box.left, y + box.top];
            }""",
            [view, [float(x) for x in pixel]],
        )

    def click(self, view, pixel, free=False):
        """Click a pixel of a view; a free click does not snap to a corner."""
        if free:
            self.page.keyboard.down("Alt")
        self.page.mouse.click(*self.place(view, pixel))
        if free:
            self.page.keyboard.up("Alt")
        self.settle()

    def settle(self):
        """Wait until the page has its answer and has drawn it."""
        # A page that never answers would otherwise be waited for without end.
        self.page.evaluate(
            """(patience) => Promise.race([
                (async () => {
                    await smartviewEditor.busy;
                    await new Promise((done) => requestAnimationFrame(() => setTimeout(done, 0)));
                    await smartviewEditor.busy;
                })(),
                new Promise((_, fail) => setTimeout(() => fail(new Error("no answer")), patience)),
            ])""",
            PATIENCE,
        )

    def crash_browser(self):
        """End the browser's processes at once, as a power cut or the system would."""
        browser = self.page.context.browser
        with contextlib.suppress(Exception):  # there is nobody left to answer
            browser.new_browser_cdp_session().send("Browser.crash")
        assert not browser.is_connected()

    def key(self, name):
        self.page.keyboard.press(name)
        self.settle()

    def said(self):
        return self.page.inner_text(".said")

    def counts(self):
        return self.page.evaluate(
            "['points', 'edges', 'faces', 'grasps'].map((k) => smartviewEditor.model[k].size)"
        )


def serve_in_process(path, folder):
    """A server of its own process, which can be killed; returns it and its address."""
    code = """
import sys; sys.path.insert(0, sys.argv[2])
from editor_scene import drawn_scene
from smartview_jax.editor import ModelSession, serve
scene = drawn_scene()
session = ModelSession(scene.calibration, scene.base_from_tool, scene.pictures, path=sys.argv[1])
serve(session, 0, lambda address: print(address, flush=True))
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(path), str(folder)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ},
    )
    return process, process.stdout.readline().strip()
