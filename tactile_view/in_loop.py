"""Changes of the page's elements, all made in the thread of viser's event loop.

A change wakes the task that sends to each open page, and viser wakes it in whatever thread makes the change:
with several pages open the loop may be going through the same waiting tasks just then, which ends it
("deque mutated during iteration").
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any

import viser


def wait_for(server: viser.ViserServer, act: Callable[[], None]) -> None:
    """Have the loop do something, and wait for it; raises what it raises. Not to be called in the loop."""

    async def run() -> None:
        act()

    asyncio.run_coroutine_threadsafe(run(), server.get_event_loop()).result()


def later(server: viser.ViserServer, act: Callable[[], None]) -> None:
    """Have the loop do something, from whatever thread; nothing once the page has ended."""
    with contextlib.suppress(RuntimeError):  # the loop is closed
        server.get_event_loop().call_soon_threadsafe(act)


def handler(act: Callable[[Any], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """What an element calls with an event: viser runs a coroutine in its loop, and functions in threads."""

    async def handle(event: Any) -> None:
        act(event)

    return handle
