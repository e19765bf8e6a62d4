"""Our profile of Fast DDS (config/dds/fastdds.xml): quick discovery, and shared memory that holds images."""

from __future__ import annotations

import os

from tactile_base.config_paths import config_path

VARIABLE = "FASTDDS_DEFAULT_PROFILES_FILE"
_DEPRECATED = "FASTRTPS_DEFAULT_PROFILES_FILE"


def use_dds_profile() -> None:
    """Name our profile to Fast DDS, unless the user has named one; call it before `rclpy.init`.

    Other middlewares do not look at the variable. Without the file (a package that was only partly installed)
    discovery works as well, only more slowly.
    """
    if VARIABLE in os.environ or _DEPRECATED in os.environ:
        return
    try:
        os.environ[VARIABLE] = str(config_path("dds/fastdds.xml"))
    except FileNotFoundError:
        return
