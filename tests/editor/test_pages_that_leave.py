"""Pages that leave a real server abruptly, with changes of theirs on the way, leave alone."""

import asyncio
import json
import urllib.request
from urllib.parse import urlsplit

import pytest
from browser import serve_in_thread
from editor_scene import drawn_scene
from sessions import open_session

websockets = pytest.importorskip("websockets", reason="the editor's server is not installed")

PAGES, LEAVING = 10, 3
PATIENCE = 60.0
"""Longest wait for anything, s."""


@pytest.fixture
def address(tmp_path):
    session = open_session(drawn_scene(), tmp_path / "object.json")
    return serve_in_thread(session)


async def renamed(page, name):
    await page.send(json.dumps({"do": "rename", "name": name, "message": 1}))


async def heard(page, name):
    """Wait until a page is told of a name."""
    while name not in await page.recv():
        pass


async def leave_and_change(address):
    origin = f"http://{urlsplit(address).netloc}"
    with urllib.request.urlopen(address) as response:
        cookie = response.headers["set-cookie"].split(";")[0]
    pages = [
        await websockets.connect(
            origin.replace("http", "ws") + "/socket",
            origin=origin,
            additional_headers={"cookie": cookie},
            max_size=None,
            ping_interval=None,
        )
        for _ in range(PAGES)
    ]
    # With several changes waiting for their turn, the loops of these pages cannot notice.
    for k in range(4):
        await asyncio.gather(*(renamed(page, f"page {i}, {k}") for i, page in enumerate(pages)))
    await asyncio.sleep(0.1)
    for page in pages[:LEAVING]:
        page.transport.abort()
    staying = pages[LEAVING:]
    await renamed(staying[0], "the last name")
    await asyncio.gather(*(heard(page, "the last name") for page in staying))
    for page in staying:
        await page.close()


def test_the_others_are_still_told_of_changes(address):
    asyncio.run(asyncio.wait_for(leave_and_change(address), PATIENCE))
