"""`tactile view` and `tactile foxglove`: look at a running graph or a recording in a browser."""

from __future__ import annotations

import argparse
import importlib.util
import signal
from pathlib import Path
from typing import Any

from tactile_base.priority import give_way
from tactile_bringup.commands.changes import add_command

HOST, PORT, FOXGLOVE_PORT = "127.0.0.1", 8098, 8765
OPEN_TO_OTHERS = "whoever has this address with its token can {do}; nothing is encrypted: see SECURITY.md"


def register(subparsers: Any) -> None:
    """Add both."""
    _register_foxglove(subparsers)
    add = add_command(
        subparsers,
        "view",
        run,
        epilog="Exit codes: 0 ended by the user, 2 nothing to show.",
    ).add_argument
    add("bag", nargs="?", type=Path, metavar="BAG", help="a recording (default: the running graph)")
    add("--port", type=int, default=PORT, help=f"({PORT})")
    text = "address to serve at; another than this host's lets others act, too, who have the address printed"
    add("--host", default=HOST, help=text)
    add("--read-only", action="store_true", help="a page that cannot act: no buttons, goals or settings")


def _register_foxglove(subparsers: Any) -> None:
    add = add_command(
        subparsers,
        "foxglove",
        run_foxglove,
        epilog="Exit codes: 0 ended by the user, 2 not started.",
    ).add_argument
    add("--port", type=int, default=FOXGLOVE_PORT, help=f"({FOXGLOVE_PORT})")
    add("--host", default=HOST, help="address to serve at; another than this host's lets others look, too")


def run_foxglove(arguments: argparse.Namespace) -> int:
    """Serve the topics of a running graph over the web socket of Foxglove, which Lichtblick speaks too.

    Open a connection 'Foxglove WebSocket' to the address that it prints. Only what somebody looks at is
    heard, and nothing can be sent. These programs open recordings as they are.
    """
    _require("foxglove", "foxglove-sdk")
    from tactile_base.console import lasting_console, say
    from tactile_base.end_signals import signals_into
    from tactile_bringup.commands.operate import chosen_domain
    from tactile_view.live_foxglove import FoxgloveBridge

    signals = list[int]()
    give_way()  # whoever looks must not hold up what is looked at
    try:
        bridge = FoxgloveBridge(chosen_domain(), arguments.host, arguments.port)
    except RuntimeError as error:  # as of a port that is taken
        raise ValueError(f"{arguments.host}:{arguments.port} cannot be served: {error}") from error
    with bridge:
        signals_into(signals)
        say(lasting_console(), f"serving ws://{arguments.host}:{bridge.server.port}; Ctrl-C ends it")
        bridge.run(lambda: bool(signals))
    return _code(signals)


def _require(module: str, package: str) -> None:
    if importlib.util.find_spec(module) is None:
        raise ValueError(f"needs {package}: pip install 'tactile_servoing[view]', or {package} alone")


def _code(signals: list[int]) -> int:
    return 0 if signals[:1] in ([], [signal.SIGINT], [signal.SIGTERM]) else 128 + signals[0]


def run(arguments: argparse.Namespace) -> int:
    """Serve a page that shows a running graph, or a recording with a time line.

    It has the arms, the believed contact with its uncertainty, the tactile image and all settings. Open the
    address that it prints in a browser; Ctrl-C ends it.
    """
    _require("viser", "viser")
    from tactile_base.console import lasting_console, say
    from tactile_base.end_signals import end_with_launcher, signals_into

    end_with_launcher()
    console, signals = lasting_console(), list[int]()
    give_way()  # whoever looks must not hold up what is looked at
    page = _page(arguments)
    signals_into(signals)
    say(console, f"open {page.address} in a browser; Ctrl-C ends the page, not the arms")
    if arguments.host not in (HOST, "localhost", "::1"):
        do = "look" if arguments.read_only or arguments.bag else "start goals and change settings"
        say(console, OPEN_TO_OTHERS.format(do=do), "yellow")
    try:
        page.run(lambda: bool(signals))
        page.say_end()
    finally:
        page.close()
    return _code(signals)


def _page(arguments: argparse.Namespace) -> Any:
    """The page of a recording, or of the graph in the domain of this terminal."""
    where = arguments.host, arguments.port
    if arguments.bag is not None:
        from tactile_view.cell_state import CellState
        from tactile_view.recording import Recording
        from tactile_view.recording_page import RecordingPage, scene_of_bag

        state = CellState()
        recording = Recording(arguments.bag, state)
        state.types = recording.types
        return RecordingPage(recording, state, scene_of_bag(recording.bag), *where)
    from tactile_bringup.commands.operate import chosen_domain
    from tactile_view.cell_state import CellState
    from tactile_view.live import LiveGraph
    from tactile_view.live_page import LivePage

    domain, state = chosen_domain(), CellState()
    return LivePage(LiveGraph(domain, state), state, *where, arguments.read_only)
