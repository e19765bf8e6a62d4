"""What is checked before the first process of a graph starts: it would end a node seconds later, or worse.

Limits of this process, which its children inherit; the middleware that the environment names; and the models
of all estimators, as these check them (`Estimator`). It takes a third of a second, and as much more where a
middleware is named.
"""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from typing import TYPE_CHECKING

from ament_index_python.resources import get_resources

from tactile_base.process_limits import GRAPH, LimitError, require
from tactile_perception.estimating.estimator import Estimator, ModelError

if TYPE_CHECKING:
    from tactile_bringup.graph import Graph

MIDDLEWARE = "RMW_IMPLEMENTATION"
_LOAD = (
    "from rclpy.utilities import get_rmw_implementation_identifier as name; name()"  # ends a process with 102
)
_INDIRECTION = "rmw_implementation"  # the package that loads one of the others


class CannotStart(ValueError):
    """What keeps a graph from being started, with what would be right; nothing has been started."""


def check_start(graph: Graph) -> None:
    """Raise `CannotStart` for what is known to keep the processes of this graph from their work."""
    check_process()
    check_models(graph)


def check_process() -> None:
    """Raise `CannotStart` for what would keep any node from working in this environment."""
    try:
        require(GRAPH, "a node")
    except LimitError as error:
        raise CannotStart(str(error)) from error
    check_middleware()


def check_models(graph: Graph) -> None:
    """Raise `CannotStart` for a model that its estimator would refuse."""
    nodes = {node.parameters.get("model", ""): node for node in graph.nodes if node.executable == "estimator"}
    for model, node in nodes.items():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the node logs it
                Estimator(model)
        except ModelError as error:
            raise CannotStart(f"model of {node.full_name}: {error}") from error


def check_middleware() -> None:
    """Raise `CannotStart` for a middleware that is named and cannot be loaded.

    A process of its own asks for it, since ROS ends one that does so in vain, with exit code 102.
    """
    name = os.environ.get(MIDDLEWARE, "")
    if not name:
        return
    done = subprocess.run([sys.executable, "-c", _LOAD], capture_output=True, text=True)
    if done.returncode:
        there = ", ".join(sorted(set(get_resources("rmw_typesupport")) - {_INDIRECTION})) or "none"
        raise CannotStart(
            f"{MIDDLEWARE}={name}: ROS 2 cannot load it here; installed: {there}; "
            f"set it to one of them or type `unset {MIDDLEWARE}`"
        )
