"""Who may open the page: pages of its own address alone, and no more than a few at once.

viser serves whoever asks. A browser lets any web site open a socket to this host, so without a look at where
a page comes from, every site that is visited beside could stop or start an arm.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import websockets.asyncio.server

MOST_PAGES = 16
TRY_AGAIN_LATER = 1013  # RFC 6455's registry: the server is too busy
LOCAL = ("127.0.0.1", "localhost", "[::1]")


@contextlib.contextmanager
def only_own_pages(host: str) -> Iterator[None]:
    """Within it, servers of `websockets` that are started let in only pages that they served themselves.

    `host` is what they listen at; whoever opens the page by another name of it is refused.
    """
    serve: Any = websockets.asyncio.server.serve
    connected: set[Any] = set()

    def guarded(handler: Any, address: str, port: int, **options: Any) -> Any:
        async def handle(connection: Any) -> None:
            if len(connected) >= MOST_PAGES:
                await connection.close(TRY_AGAIN_LATER, f"{MOST_PAGES} pages are open already")
                return
            connected.add(connection)
            try:
                await handler(connection)
            finally:
                connected.discard(connection)

        names = {*LOCAL, host}
        origins = [f"http://{name}:{port}" for name in sorted(names)]
        return serve(handle, address, port, origins=origins, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
