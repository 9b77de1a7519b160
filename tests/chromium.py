"""A browser for tests of pages; they are skipped where there is none."""

import shutil
from pathlib import Path

import pytest

ARGUMENTS = """
    --no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-quic --no-first-run
    --disable-background-networking --disable-component-update --disable-sync
""".split()


def browser_or_skip():
    """A function that starts a browser, with its reason to be killed; skips where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    pytest.importorskip("uvicorn", reason="the editor's server is not installed")
    installed = shutil.which("chromium") or shutil.which("chromium-browser")
    playwright = sync_api.sync_playwright().start()
    path = installed or playwright.chromium.executable_path
    if not Path(path).is_file():
        playwright.stop()
        pytest.skip("no chromium: neither installed here nor by `playwright install chromium`")
    return playwright, path


class Chromium:
    """A browser that is started when it is needed, also after it crashed."""

    def __init__(self, playwright, path):
        self._launch = playwright.chromium.launch
        self._path, self._browser = path, None

    def running(self):
        if self._browser is None or not self._browser.is_connected():
            self._browser = self._launch(executable_path=self._path, args=ARGUMENTS)
        return self._browser

    def close(self):
        if self._browser is not None:
            self._browser.close()
