"""Sensor files: a simulated TacTip with parameters of its own, such as those fitted to a real one.

A file of `config/sensors` has the groups of `TacTipSettings` (skin, contact, markers, camera), and for data
sets `collection` (the rig: errors of its arm, friction) and `variation` (how images differ); all optional::

    sensor = load_sensor("tactip_franka")
    TacTip(sensor.sensor)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from tactile_base.config_paths import named_file
from tactile_base.yaml_file import read_yaml
from tactile_drivers.sim.collection import CollectionSettings
from tactile_drivers.sim.settings import TacTipSettings
from tactile_drivers.sim.simulation import read_sensor_groups
from tactile_drivers.sim.variation import VariationSettings


@dataclass(frozen=True)
class SensorFile:
    """What a sensor file says; without one, the defaults."""

    sensor: TacTipSettings = field(default_factory=TacTipSettings)
    collection: CollectionSettings = field(default_factory=CollectionSettings)
    variation: VariationSettings | None = None


def load_sensor(name_or_path: str | Path) -> SensorFile:
    """A sensor of `config/sensors` by its name, or any sensor file by its path.

    Raises
    ------
    FileNotFoundError
        With the names there are.
    SettingError
        With file and line of what is wrong.
    """
    root = read_yaml(named_file("sensor", name_or_path))
    return SensorFile(
        read_sensor_groups(root),
        root.settings("collection", CollectionSettings),
        root.settings("variation", VariationSettings) if "variation" in root.values else None,
    )
