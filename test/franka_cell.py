"""A cell with the driver of a Franka behind the safe command stage, and the double of its controller."""

import json
from pathlib import Path
from typing import ClassVar

import real_arm

LIMITS = (
    "{linear_velocity: 0.1, angular_velocity: 0.5, linear_acceleration: 1.0, angular_acceleration: 4.0, "
    "linear_jerk: 500.0, angular_jerk: 1000.0}"
)


class Double(real_arm.Double):
    """That of a Franka, whose time stands still while a busy machine holds its driver up."""

    mended: ClassVar = [
        "silence 0", "deaf 0", "slow 0", "garbled 0", "loss 0", "success_rate 1", "reflex_stays 0",
        "runs_away 0", "restore", "come_back",
    ]  # fmt: skip
    module = "tactile_doubles.franka_controller"

    def __init__(self, host: str, **settings):
        super().__init__(host, **{"tolerance": 5.0, "patience": 0.1, **settings})


def scene_file(folder: Path, host: str, limits: str = LIMITS, **settings) -> Path:
    """A scene of an FR3 with a sensor that stands 65 mm out of its end effector."""
    given = {"host": host, "realtime": False, **settings}
    path = folder / "franka_cell.yaml"
    path.write_text(
        "arms:\n  arm:\n    driver: franka\n"
        f"    driver_settings: {json.dumps(given)}\n"
        f"    limits: {limits}\n"
        "    start: {position: [0.4, 0.0, 0.235], rotation_deg: [180, 0, 0]}\n"
        "    sensor: {in_tool: {position: [0.0, 0.0, 0.065]}, camera: external}\n"
    )
    return path
