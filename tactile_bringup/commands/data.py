"""Make data sets, simulated or with an arm, import those of other labs, and check them."""

from __future__ import annotations

from typing import Any

from tactile_bringup.commands import data_check as check_command
from tactile_bringup.commands import data_collect as collect_command
from tactile_bringup.commands import data_generate as generate_command
from tactile_bringup.commands import data_import as import_command
from tactile_bringup.commands import data_shard as shard_command
from tactile_bringup.commands.changes import add_group


def register(subparsers: Any) -> None:
    commands = add_group(subparsers, "data", __doc__)
    for module in (generate_command, collect_command, import_command, shard_command, check_command):
        module.register(commands)
