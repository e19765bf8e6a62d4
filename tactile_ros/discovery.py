"""With whom nodes speak: with this host alone, unless the user asks for more; Fast DDS's profile for either.

ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST says whom a node looks for, not who finds it: its sockets are bound to
all addresses, and whoever names this host in ROS_STATIC_PEERS is let in. The profile of this host binds what
is listened to on 127.0.0.1, so that the kernel keeps others out.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

from tactile_base.config_paths import packaged_path

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
HERE, WIDE = "LOCALHOST", ("SUBNET", "SYSTEM_DEFAULT")
PEERS = ("ROS_STATIC_PEERS", "ROS_DISCOVERY_SERVER")
# what names a profile to Fast DDS, and what did in the past
PROFILE_VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
THIS_HOST, ALL_HOSTS = "dds/this_host.xml", "dds/all_hosts.xml"


def asked_for_others(variables: Mapping[str, str]) -> str:
    """Which variable of the user's lets other hosts take part, as NAME=value; empty: this host alone.

    Of a profile of the user's own nobody knows whom it lets in.
    """
    asked = [RANGE] if variables.get(RANGE) in WIDE else []
    asked += [name for name in PEERS if variables.get(name)]
    asked += [name for name in PROFILE_VARIABLES if _is_users(variables.get(name))]
    return ", ".join(f"{name}={variables[name]}" for name in asked)


def use_dds_profile() -> None:
    """Name our profile to Fast DDS, unless the user has named one; call it before `rclpy.init`.

    Both of ours make discovery quick, and shared memory large enough for images; other middlewares do not
    look at the variable. A process that was started by one of ours inherits its choice and makes its own.

    Raises
    ------
    FileNotFoundError
        Without the file nobody would be kept out.
    """
    if any(_is_users(os.environ.get(name)) for name in PROFILE_VARIABLES):
        return
    name = ALL_HOSTS if asked_for_others(os.environ) else THIS_HOST
    if not os.environ.get(RANGE):  # which would be SUBNET
        os.environ[RANGE] = HERE
    os.environ[PROFILE_VARIABLES[0]] = str(packaged_path(name))


def _is_users(profile: str | None) -> bool:
    """Whether a variable names a profile that is none of ours, of whichever installation."""
    return bool(profile) and not str(profile).endswith((f"/{THIS_HOST}", f"/{ALL_HOSTS}"))
