"""Who may open the page: not the page of another site, not a thousand, and nothing sent there ends it."""

import asyncio
import contextlib
import os

import pytest
import viser
import websockets
from cell_messages import record

from tactile_view.cell_state import CellState
from tactile_view.door import MOST_PAGES
from tactile_view.recording import Recording
from tactile_view.recording_page import RecordingPage


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    state = CellState()
    recording = Recording(record(tmp_path_factory.mktemp("page") / "bag", 1.0), state)
    page = RecordingPage(recording, state, None, "127.0.0.1", 0)
    yield page
    page.close()


async def opened(page, origin: str):
    address = page.address.replace("http", "ws")
    return await websockets.connect(address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"])


def test_its_own_page_is_let_in(page):
    async def run():
        async with await opened(page, page.address) as socket:
            assert await asyncio.wait_for(socket.recv(), 10.0)

    asyncio.run(run())


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", ""])
def test_the_page_of_another_site_is_not(page, origin):
    async def run():
        with pytest.raises(websockets.InvalidStatus):
            await opened(page, origin)

    asyncio.run(run())


def test_no_more_pages_than_it_can_serve(page):
    async def run():
        sockets = []
        with contextlib.suppress(Exception):
            for _ in range(MOST_PAGES):
                sockets.append(await opened(page, page.address))
        assert len(sockets) == MOST_PAGES
        extra = await opened(page, page.address)
        with pytest.raises(websockets.ConnectionClosed) as closed:
            while True:
                await asyncio.wait_for(extra.recv(), 10.0)
        assert "pages are open already" in str(closed.value)
        for socket in sockets:
            await socket.close()

    asyncio.run(run())


def test_garbage_ends_a_connection_and_not_the_page(page):
    async def run():
        for data in (b"", b"\x00" * 10, os.urandom(1000), "text", b"\x93\x01\x02\x03"):
            with contextlib.suppress(websockets.ConnectionClosed, OSError):
                async with await opened(page, page.address) as socket:
                    await socket.send(data)
                    await asyncio.sleep(0.1)
        async with await opened(page, page.address) as socket:
            assert await asyncio.wait_for(socket.recv(), 10.0)

    asyncio.run(run())
