"""`tactile data`: makes data sets, simulated, with an arm or of other labs, and checks them."""

from __future__ import annotations

from typing import Any

from tactile_bringup.commands import data_check as check_command
from tactile_bringup.commands import data_collect as collect_command
from tactile_bringup.commands import data_generate as generate_command
from tactile_bringup.commands import data_import as import_command


def register(subparsers: Any) -> None:
    """Add `data` with its subcommands to argparse subparsers."""
    data = subparsers.add_parser("data", help="make, import and check data sets")
    commands = data.add_subparsers(dest="data_command", metavar="COMMAND", required=True)
    for module in (generate_command, collect_command, import_command, check_command):
        module.register(commands)
