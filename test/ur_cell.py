"""A cell with the driver of a UR behind the safe command stage, and the double of its controller."""

import json
from pathlib import Path
from typing import ClassVar

import real_arm


class Double(real_arm.Double):
    """That of a UR."""

    mended: ClassVar = [
        "silence 0", "slow 0", "garbled 0", "stuck_program 0", "torn 0", "loss 0", "teach_button 0",
        "payload 0", "speed_slider 1", "restore", "come_back",
    ]  # fmt: skip
    module = "tactile_doubles.ur_controller"


def scene_file(
    folder: Path, host: str, rate: float = 125.0, limits: str = "{}", kinematics: str = "", **settings
) -> Path:
    """A scene of a UR with a sensor that stands 65 mm out of its TCP."""
    given = {"host": host, "rate": rate, **settings}
    path = folder / "ur_cell.yaml"
    path.write_text(
        "arms:\n  arm:\n    driver: ur\n"
        f"    driver_settings: {json.dumps(given)}\n"
        f"    limits: {limits}\n"
        "    start: {position: [0.4, 0.0, 0.235], rotation_deg: [180, 0, 0]}\n"
        "    sensor: {in_tool: {position: [0.0, 0.0, 0.065]}, camera: external}\n"
        + f"    kinematics: {kinematics}\n"
        * bool(kinematics)
    )
    return path
