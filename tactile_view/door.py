"""Who may open the page: pages of its own address alone, with its token, and no more than a few at once.

viser serves whoever asks. A browser lets any web site open a socket to this host, so without a look at where
a page comes from, every site that is visited beside could stop or start an arm. A page that other hosts reach
needs a token, which stands in the address that is printed and which the browser then keeps as a cookie.
"""

from __future__ import annotations

import contextlib
import hmac
import inspect
import secrets
from collections.abc import Awaitable, Callable, Iterator
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server

MOST_PAGES = 16
TRY_AGAIN_LATER = 1013  # RFC 6455's registry: the server is too busy
LOCAL = ("127.0.0.1", "localhost", "[::1]")
NO_TOKEN = "Open the whole address that tactile view printed: its token is missing here, or wrong.\n"


def token_for(host: str) -> str:
    """What whoever opens a page has to know; '' where only this host can reach it."""
    return "" if host in (*LOCAL, "::1") else secrets.token_urlsafe(16)


@contextlib.contextmanager
def only_own_pages(host: str, token: str = "") -> Iterator[None]:
    """Within it, servers of `websockets` that are started let in only pages that they served themselves.

    `host` is what they listen at; whoever opens the page by another name of it is refused. With a `token`
    nothing is told, not even a file of the page, to whoever does not bring it.
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
        if token:
            options["process_request"] = _asked_with(token, port, options["process_request"])
        return serve(handle, address, port, origins=origins, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _asked_with(token: str, port: int, answer: Callable[[Any, Any], Any]) -> Callable[..., Awaitable[Any]]:
    """Answers requests with the token, in the address or in the cookie that such an address leaves."""
    name = f"tactile_view_{port}"  # a host's pages share their cookies

    async def asked(connection: Any, request: Any) -> Any:
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if not any(
            hmac.compare_digest(token.encode(), word.encode()) for word in (given, _kept(request, name))
        ):
            return connection.respond(HTTPStatus.FORBIDDEN, NO_TOKEN)
        response = answer(connection, request)
        if inspect.isawaitable(response):
            response = await response
        if response is not None:  # a file, not the web socket
            response.headers["Set-Cookie"] = f"{name}={token}; HttpOnly; SameSite=Strict; Path=/"
        return response

    return asked


def _kept(request: Any, name: str) -> str:
    """The value of a cookie; '' where the browser sends none."""
    try:
        cookies = SimpleCookie("; ".join(request.headers.get_all("Cookie")))
    except CookieError:
        return ""
    return cookies[name].value if name in cookies else ""
