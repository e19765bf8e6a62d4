"""What nodes that make a belief of stamped inputs have in common: how long they wait, and `~/reset`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tactile_base.settings import Settings, setting
from tactile_msgs.srv import ResetFilter
from tactile_ros.managed_node import ManagedNode


@dataclass(frozen=True)
class BeliefInputSettings(Settings):
    """How long the node waits for what it needs, and how often it publishes its frame."""

    tf_timeout: float = setting(
        0.05, lower=0.0, upper=5.0, unit="s",
        doc="an input waits this long for the sensor's pose at its stamp",
    )  # fmt: skip
    age_limit: float = setting(
        0.25, lower=0.0, upper=60.0, unit="s",
        doc="longer silence of an input is reported in /diagnostics; 0: never",
    )  # fmt: skip
    tf_rate: float = setting(
        15.0, lower=0.0, upper=1000.0, unit="Hz",
        doc="the belief is published as a frame on /tf as well, at most this often; 0: never",
    )  # fmt: skip


def serve_reset(node: ManagedNode, reset: Callable[[], None], outlook: str) -> None:
    """Offer `~/reset` while the node is configured: it forgets what it believes, if it is active.

    Parameters
    ----------
    outlook : str
        What comes next, for who asked.
    """

    def act(request: ResetFilter.Request) -> None:
        node.get_logger().info(f"reset: {request.reason or 'no reason given'}")
        reset()

    node.serve_request(ResetFilter, "~/reset", act, outlook)
