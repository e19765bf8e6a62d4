"""Who may open the page: not the page of another site, not a thousand, and nothing sent there ends it."""

import asyncio
import contextlib
import os
import threading
import time
import urllib.error
import urllib.request

import pytest
import viser
import websockets
from cell_messages import record
from raw_page import LOOKING, setting
from viser.infra._async_message_buffer import AsyncMessageBuffer

from tactile_view.cell_state import CellState
from tactile_view.door import MOST_PAGES
from tactile_view.recording import Recording
from tactile_view.recording_page import RecordingPage

PATIENCE = 300.0  # s, where a test gives way to others


@contextlib.contextmanager
def served(folder, host):
    """A page of a short recording."""
    state = CellState()
    recording = Recording(record(folder / "bag", 1.0), state)
    page = RecordingPage(recording, state, None, host, 0)
    yield page
    page.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    with served(tmp_path_factory.mktemp("page"), "127.0.0.1") as page:
        yield page


async def opened(page, origin: str):
    address = page.address.replace("http", "ws")
    return await websockets.connect(
        address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"], open_timeout=PATIENCE
    )


def test_its_own_page_is_let_in(page):
    async def run():
        async with await opened(page, page.address) as socket:
            assert await asyncio.wait_for(socket.recv(), 60.0)

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

        async def refused() -> str:
            extra = await opened(page, page.address)
            with pytest.raises(websockets.ConnectionClosed) as closed:
                while True:
                    await asyncio.wait_for(extra.recv(), PATIENCE)
            return str(closed.value)

        for _ in range(20):  # 1000 in all
            said = await asyncio.gather(*(refused() for _ in range(50)))
            assert all("pages are open already" in each for each in said)
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
            assert await asyncio.wait_for(socket.recv(), 60.0)

    asyncio.run(run())


@pytest.fixture(scope="module")
def open_page(tmp_path_factory):
    """One that other hosts can reach."""
    with served(tmp_path_factory.mktemp("open"), "0.0.0.0") as page:
        yield page


def fetched(url: str, cookie: str = "") -> tuple[int, str]:
    """Status, and the cookie that comes with the answer."""
    request = urllib.request.Request(url, headers={"Cookie": cookie} if cookie else {})
    try:
        with urllib.request.urlopen(request, timeout=10.0) as response:
            return response.status, str(response.headers["Set-Cookie"])
    except urllib.error.HTTPError as error:
        return error.code, ""


def test_elements_are_changed_in_the_servers_thread(tmp_path, monkeypatch):
    """What sends to open pages is woken in whatever thread changes an element, and may die of another one."""
    push, threads = AsyncMessageBuffer.push, set()

    def watched(buffer, message):
        threads.add(threading.current_thread())
        push(buffer, message)

    async def server_thread() -> threading.Thread:
        return threading.current_thread()

    with served(tmp_path, "127.0.0.1") as page:
        own = asyncio.run_coroutine_threadsafe(server_thread(), page.server.get_event_loop()).result()
        monkeypatch.setattr(AsyncMessageBuffer, "push", watched)

        async def look() -> None:
            async with await opened(page, page.address) as socket:
                await socket.send(LOOKING)
                while page.source.seconds < 0.5:  # what it shows goes on
                    await asyncio.wait_for(socket.recv(), 60.0)
                for element in list(page.server.gui._gui_input_handle_from_uuid):
                    await socket.send(setting(element, 1.0))
                await asyncio.sleep(0.5)

        done = threading.Event()
        looking = threading.Thread(target=lambda: (asyncio.run(look()), done.set()), daemon=True)
        looking.start()
        end = time.monotonic() + 120.0
        page.run(lambda: done.is_set() or time.monotonic() > end)
        page.say_end()
        assert done.is_set() and threads == {own}


async def socket_with(page, cookie: str):
    place = f"127.0.0.1:{page.server.get_port()}"
    return await websockets.connect(
        f"ws://{place}", origin=f"http://{place}", subprotocols=[f"viser-v{viser.__version__}"],
        additional_headers={"Cookie": cookie} if cookie else {},
    )  # fmt: skip


def test_a_page_of_this_host_alone_has_no_token(page):
    assert "token" not in page.address and fetched(page.address)[0] == 200


def test_what_others_can_reach_opens_with_the_token_of_its_address_and_the_cookie_it_leaves(open_page):
    status, cookie = fetched(open_page.address)
    assert status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
    kept = cookie.split(";")[0]
    assert fetched(open_page.address.split("?")[0], f"other=1; {kept}")[0] == 200

    async def run():
        async with await socket_with(open_page, kept) as socket:
            assert await asyncio.wait_for(socket.recv(), 60.0)

    asyncio.run(run())


@pytest.mark.parametrize("wrong", ["", "?token=", "?token=guessed", "assets/index.js", "?token=%ff"])
def test_without_the_token_there_is_not_even_a_file_of_it(open_page, wrong):
    assert fetched(open_page.address.split("?")[0] + wrong)[0] == 403


@pytest.mark.parametrize(
    "cookie", ["", "tactile_view_{port}=guessed", "tactile_view_{port}", ";;=;", "a b\\"]
)
def test_a_socket_without_the_token_is_refused(open_page, cookie):
    async def run():
        with pytest.raises(websockets.InvalidStatus, match="403"):
            await socket_with(open_page, cookie.format(port=open_page.server.get_port()))

    asyncio.run(run())
