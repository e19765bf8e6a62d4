"""GraphClient: a node in a ROS domain, with a context of its own, that does nothing unless spun."""

from __future__ import annotations

from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from tactile_ros.discovery import use_dds_profile
from tactile_ros.run_nodes import make_executor

G = TypeVar("G", bound="GraphClient")
BACKLOG = 10  # events handled at once after the first


class GraphClient:
    """A node in a ROS domain, whose enclave has the node's name; use as a context, or `close` it."""

    def __init__(self, name: str, domain_id: int) -> None:
        use_dds_profile()
        enclave = ["--ros-args", "--enclave", name]
        self._context = Context()
        rclpy.init(
            context=self._context,
            args=enclave,
            domain_id=domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.domain_id = domain_id
        self._node = Node(name.strip("/"), context=self._context, enable_rosout=False)
        self._executor = make_executor(self._context)
        self._executor.add_node(self._node)

    def __enter__(self: G) -> G:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def spin(self, timeout_s: float) -> None:
        """Handle what has arrived, waiting for at most `timeout_s` for the first of it."""
        self._executor.spin_once(timeout_sec=timeout_s)
        for _ in range(BACKLOG):  # each call handles one event
            self._executor.spin_once(timeout_sec=0.0)

    def close(self) -> None:
        """Leave the graph; no shared memory of this process is in use afterwards."""
        self._executor.remove_node(self._node)
        self._node.destroy_node()
        self._executor.shutdown()
        rclpy.try_shutdown(context=self._context)

    def node_names(self) -> set[str]:
        """Full names of the nodes in the domain, as far as they are known by now."""
        return {f"{space.rstrip('/')}/{name}" for name, space in self._node.get_node_names_and_namespaces()}
