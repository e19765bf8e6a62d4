"""A page that may only look: no message to it does anything, whoever wrote it."""

import asyncio
import time

import pytest
import websockets
from raw_page import LOOKING, setting

viser = pytest.importorskip("viser", reason="needs viser (the extra 'view')")
pytest.importorskip("rclpy", reason="needs ROS 2")

from tactile_view.cell_state import CellState  # noqa: E402
from tactile_view.live import LiveGraph  # noqa: E402
from tactile_view.live_page import LivePage  # noqa: E402


class Acts:
    """In place of hands: what the page would have done."""

    def __init__(self) -> None:
        self.done: list[str] = []

    def stop_all(self) -> None:
        self.done.append("stop")

    def ask(self, act) -> None:
        self.done.append(act.__qualname__)

    def close(self) -> None:
        pass


def done_by_raw_messages(domain: int, read_only: bool) -> list[str]:
    """What comes of setting each element that the page has, by messages that no page sent."""
    state = CellState()
    page = LivePage(LiveGraph(domain, state), state, "127.0.0.1", 0, read_only)
    page.hands.close()
    page.hands = Acts()

    async def send() -> None:
        address = page.address.replace("http", "ws")
        protocol = f"viser-v{viser.__version__}"
        async with websockets.connect(address, origin=page.address, subprotocols=[protocol]) as socket:
            await socket.send(LOOKING)
            await asyncio.sleep(0.5)
            for element in list(page.server.gui._gui_input_handle_from_uuid):
                await socket.send(setting(element, "reset"))
            await asyncio.sleep(1.0)

    try:
        asyncio.run(send())
        end = time.monotonic() + (1.0 if read_only else 20.0)
        while time.monotonic() < end and "stop" not in page.hands.done:
            time.sleep(0.05)
        return page.hands.done
    finally:
        page.close()


def test_nothing_that_is_sent_to_it_acts(graph):
    domain = int(graph.variables["ROS_DOMAIN_ID"])
    assert "stop" in done_by_raw_messages(domain, read_only=False)  # the same messages do act elsewhere
    assert done_by_raw_messages(domain, read_only=True) == []
