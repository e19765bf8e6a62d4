"""The page beside a running graph, in a real browser: settings change or are refused, it stops the arm."""

import asyncio
import contextlib
import threading

import pytest
import viser
import websockets
from browser import PATIENCE, Viewer, chromium, wait
from ramp_cell import Cell
from raw_page import LOOKING

from tactile_msgs.msg import ArmStatus

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cell(shared_graph, tmp_path_factory):
    return Cell(shared_graph, tmp_path_factory.mktemp("cell"), length=0.12)


@pytest.fixture(scope="module")
def viewer(cell, tmp_path_factory):
    with chromium() as browser:
        viewer = Viewer(browser, tmp_path_factory.mktemp("viewed"), "--port", "0", **cell.graph.variables)
        yield viewer
        viewer.close()


def field(viewer: Viewer, name: str):
    """The field in which the value of a setting is typed."""
    viewer.page.get_by_role("tab", name="Settings").click()
    row = viewer.row(name)
    row.wait_for(timeout=1e3 * PATIENCE)
    return row.locator("input").last


def told(cell: Cell, viewer: Viewer, text: str) -> bool:
    """Whether the page says it in time; the graph is listened to meanwhile."""
    return cell.graph.wait(lambda: text in viewer.text(), PATIENCE)


def test_a_changed_setting_is_in_force_in_the_node(cell, viewer):
    speed = field(viewer, "task.speed")
    speed.fill("0.012")
    speed.press("Enter")
    assert told(cell, viewer, "task.speed = 0.012 is in force")
    assert cell.graph.get_parameter("controller", "task.speed") == 0.012
    viewer.page.get_by_text("undo", exact=True).dispatch_event("click")
    assert told(cell, viewer, "task.speed = 0.01 is in force")
    assert cell.graph.get_parameter("controller", "task.speed") == 0.01


def test_a_refused_value_says_why_and_goes_back(cell, viewer):
    depth = field(viewer, "pid.kp x y z")
    before = depth.input_value()
    depth.fill("-1")
    depth.press("Enter")
    assert told(cell, viewer, "refuses pid.kp")
    assert wait(lambda: float(depth.input_value()) == float(before))
    assert gains(cell)[2] == float(before)


def gains(cell: Cell) -> list[float]:
    return list(cell.graph.get_parameter("controller", "pid.kp"))


def test_one_gain_of_six_is_changed_and_the_others_stay(cell, viewer):
    was = gains(cell)
    depth = field(viewer, "pid.kp x y z")

    def typed() -> bool:
        """A browser that is busy drawing may lose what is typed right after a refused value went back."""
        depth.fill("1.5")
        depth.press("Enter")
        return cell.graph.wait(lambda: "pid.kp = [0.0, 0.0, 1.5" in viewer.text(), 5.0)

    assert wait(typed) and gains(cell) == [*was[:2], 1.5, *was[3:]]
    viewer.page.get_by_text("undo", exact=True).dispatch_event("click")
    assert cell.graph.wait(lambda: gains(cell) == was, PATIENCE)
    roll = field(viewer, "task.roll")
    roll.fill("0.2")
    roll.press("Enter")
    assert told(cell, viewer, "task.roll = 0.2 is in force")


def test_the_button_stops_the_arm_in_motion(cell, viewer):
    handle = cell.following()
    viewer.page.get_by_role("button", name="STOP all arms").click()
    assert cell.graph.wait(lambda: cell.arms[-1].mode == ArmStatus.ESTOP and not any(cell.arms[-1].twist))
    assert not cell.result(handle).success
    assert told(cell, viewer, "emergency stop")
    viewer.page.get_by_text("reset", exact=True).click()
    assert cell.graph.wait(lambda: cell.arms[-1].mode != ArmStatus.ESTOP)


def test_what_arms_say_comes_to_the_page_only_while_somebody_looks(cell, viewer):
    def heard() -> bool:
        readers = cell.graph.node.get_subscriptions_info_by_topic("/arm/arm/pose")
        return "tactile_view" in {reader.node_name for reader in readers}

    assert cell.graph.wait(heard)
    viewer.page.goto("about:blank")
    assert cell.graph.wait(lambda: not heard())
    viewer.page.goto(viewer.address)
    assert cell.graph.wait(heard) and told(cell, viewer, "surface_following")


class Flood(threading.Thread):
    """Sends as much as the page's socket takes, on several at once, until it is told to end."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self.sent, self.ends, self._address = 0, False, address
        self.start()

    def run(self) -> None:
        asyncio.run(self._send())

    async def _send(self) -> None:
        await asyncio.gather(*(self._one() for _ in range(8)))

    async def _one(self) -> None:
        protocol = f"viser-v{viser.__version__}"
        while not self.ends:
            with contextlib.suppress(websockets.WebSocketException, OSError, TimeoutError):  # it may end one
                async with websockets.connect(
                    self._address.replace("http", "ws"), origin=self._address, subprotocols=[protocol]
                ) as socket:
                    while not self.ends:
                        await asyncio.wait_for(socket.send(LOOKING), 1.0)
                        self.sent += 1


def test_a_flood_to_the_page_changes_nothing_for_the_arm(cell, viewer):
    handle = cell.following()
    flood = Flood(viewer.address)
    result = cell.result(handle)
    flood.ends = True
    flood.join()
    assert result.success, result.reason
    assert flood.sent > 1000 and viewer.process.poll() is None


def test_what_becomes_of_the_page_changes_nothing_for_the_arm(cell, viewer):
    """Held up and killed in mid motion: the goal ends as if nobody had looked."""
    import signal

    handle = cell.following()
    viewer.process.send_signal(signal.SIGSTOP)
    cell.graph.spin(1.0)
    assert cell.statuses[-1].phase == "follow" and cell.statuses[-1].reason == ""
    viewer.process.kill()
    result = cell.result(handle)
    assert result.success, result.reason
