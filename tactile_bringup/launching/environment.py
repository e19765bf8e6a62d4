"""The environment in which nodes run: discovery on this host, a ROS domain of their own, one thread each."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tactile_ros.discovery import HERE, RANGE, asked_for_others

DOMAINS = range(1, 101)  # above 101 the ports collide with the ephemeral ones of Linux
_PORT_BASE, _PORTS_PER_DOMAIN, _FIRST_UNICAST, _PORTS_PER_PARTICIPANT = 7400, 250, 10, 2
_PARTICIPANTS = 32  # of a domain whose ports are looked at


@dataclass(frozen=True)
class RosEnvironment:
    """Variables for the nodes and for this process.

    Attributes
    ----------
    variables : the whole environment of a node
    domain_id : ROS_DOMAIN_ID in it
    domain_chosen : false where the user had set ROS_DOMAIN_ID
    """

    variables: Mapping[str, str]
    domain_id: int
    domain_chosen: bool

    @property
    def discovery(self) -> str:
        """With whom the nodes speak: their range, and which variables let other hosts in."""
        asked = asked_for_others(self.variables)
        return self.variables[RANGE] + (f", open to other hosts by {asked}" if asked else "")

    @property
    def shared(self) -> bool:
        """Whether others may be in the domain now."""
        here = not asked_for_others(self.variables)
        return not (self.domain_chosen or (here and _is_free(self.domain_id)))


def ros_environment(log_folder: Path, base: Mapping[str, str] | None = None) -> RosEnvironment:
    """The environment of a run, from `base` (default: ours). What the user has set is kept.

    Raises
    ------
    ValueError
        ROS_DOMAIN_ID is not a number from 0 to 232.
    RuntimeError
        Every domain is in use.
    """
    variables = dict(os.environ if base is None else base)
    given = variables.get("ROS_DOMAIN_ID", "")
    domain_id = _checked_domain(given) if given else free_domain_id()
    variables["ROS_DOMAIN_ID"] = str(domain_id)
    variables[RANGE] = variables.get(RANGE) or HERE
    variables["ROS_LOG_DIR"] = str(log_folder)
    variables["RCUTILS_COLORIZED_OUTPUT"] = "0"
    variables["PYTHONUNBUFFERED"] = "1"
    variables.setdefault("PYTHONSAFEPATH", "1")  # else sources in the working folder hide what is installed
    return RosEnvironment(variables, domain_id, domain_chosen=not given)


def free_domain_id(start: int | None = None) -> int:
    """A domain without participants on this host; each process starts its search elsewhere."""
    first = os.getpid() if start is None else start
    for step in range(len(DOMAINS)):
        domain = DOMAINS[(first + step) % len(DOMAINS)]
        if _is_free(domain):
            return domain
    raise RuntimeError(
        f"all ROS domains {DOMAINS[0]} to {DOMAINS[-1]} are in use on this host; set ROS_DOMAIN_ID"
    )


def _is_free(domain: int) -> bool:
    """Looks behind the first port, too: a process's second participant takes the second in any domain."""
    first = _PORT_BASE + _PORTS_PER_DOMAIN * domain + _FIRST_UNICAST
    return all(_is_unused(first + _PORTS_PER_PARTICIPANT * number) for number in range(_PARTICIPANTS))


def _is_unused(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True


def _checked_domain(text: str) -> int:
    if not text.isdigit() or int(text) > 232:
        raise ValueError(f"ROS_DOMAIN_ID = {text!r}: must be a number from 0 to 232 (101 on most Linux)")
    return int(text)


_KEYLESS = """\
import rclpy
rclpy.init(args=["--ros-args", "--enclave", "/doctor"])
rclpy.create_node("doctor")
"""


def start_without_keys() -> str:
    """What a node that is to use keys of SROS 2 says where it finds none; empty if it starts all the same."""
    with tempfile.TemporaryDirectory(prefix="tactile_keystore_") as keystore:
        (Path(keystore) / "enclaves/doctor").mkdir(parents=True)
        told = {"ENABLE": "true", "STRATEGY": "Enforce", "KEYSTORE": keystore, "ENCLAVE_OVERRIDE": ""}
        security = {f"ROS_SECURITY_{name}": value for name, value in told.items()}
        command = [sys.executable, "-c", _KEYLESS]
        done = subprocess.run(command, env={**os.environ, **security}, capture_output=True, text=True)
    return done.stderr if done.returncode else ""


def middleware() -> str:
    """The name of the middleware that rclpy uses here."""
    from rclpy.utilities import get_rmw_implementation_identifier

    return str(get_rmw_implementation_identifier())
