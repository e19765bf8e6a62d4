"""The section `simulation` of a scene: all that only a simulation needs (docs/scenes.md).

simulation:
rate: 120
sensors:
left: {fidelity: image, image: {contact: {friction: 0.9}}}
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from tactile_base.config_paths import named_file
from tactile_base.settings import SettingError, unknown_name
from tactile_base.yaml_file import Section, read_yaml
from tactile_scene.simulated_sensors import FittedSensorSettings, IdealSensorSettings, TacTipSettings

#: Images drawn as the network sees them, at its size: for runs without nodes, where nobody else looks.
INPUT = "input"
#: By fidelity, from the slowest to the fastest, the settings of the sensor's model (docs/simulator.md).
MODELS: Mapping[str, type[TacTipSettings | IdealSensorSettings]] = {
    "image": TacTipSettings,
    INPUT: TacTipSettings,
    "fitted": FittedSensorSettings,
    "ideal": IdealSensorSettings,
}
FIDELITIES = tuple(MODELS)
_SENSOR_GROUPS = tuple(item.name for item in fields(TacTipSettings))
_FAULTS = ("delay", "in_tool")  # what the scene does not know of the sensor
LARGEST_DELAY = 0.5  # s
_DATA_GROUPS = ("collection", "variation", "preprocessing")


@dataclass(frozen=True)
class SimulatedSensor:
    """How a sensor is simulated: as images of a soft tip, or as its contact pose with errors.

    Attributes
    ----------
    model : TacTipSettings or IdealSensorSettings
    at_input : bool
        Images are drawn as a network sees them, see `Cell`.
    delay : float
        Frames come, and are stamped, this long after their exposure, s.
    in_tool : tuple of float
        Where the sensor really is in the arm's tool (x, y, z, alpha, beta, gamma), m and rad; empty: where
        the scene says.
    """

    model: TacTipSettings | IdealSensorSettings = field(default_factory=TacTipSettings)
    at_input: bool = False
    delay: float = 0.0
    in_tool: tuple[float, ...] = ()

    @property
    def fidelity(self) -> str:
        """One of `FIDELITIES`."""
        return INPUT if self.at_input else next(n for n, kind in MODELS.items() if type(self.model) is kind)

    @property
    def gives_images(self) -> bool:
        """Whether it does, and not estimates."""
        return isinstance(self.model, TacTipSettings)

    @property
    def tip_radius(self) -> float:
        """Radius (m) of the hemispherical tip."""
        return self.model.skin.radius if isinstance(self.model, TacTipSettings) else self.model.radius

    def with_tip_radius(self, radius: float) -> SimulatedSensor:
        """A copy with a tip of this radius (m)."""
        if isinstance(self.model, TacTipSettings):
            model = replace(self.model, skin=self.model.skin.replaced(radius=radius))
            return replace(self, model=model)
        return replace(self, model=self.model.replaced(radius=radius))

    def changed(self, fidelity: str, **model: Any) -> SimulatedSensor:
        """A sensor of this fidelity with settings of its model given by name.

        They start from those of this sensor where the model is the same, else from the defaults.
        """
        if fidelity not in MODELS:
            raise SettingError(f"fidelity: {unknown_name(fidelity, FIDELITIES)}")
        base = SimulatedSensor(MODELS[fidelity]()).with_tip_radius(self.tip_radius)
        settings = self.model if type(self.model) is MODELS[fidelity] else base.model
        return replace(self, model=replace(settings, **model), at_input=fidelity == INPUT)


@dataclass(frozen=True)
class Simulation:
    """How a scene is simulated.

    Attributes
    ----------
    rate : int
        Steps in a second: the arms' poses, and a multiple of every simulated camera's rate (Hz).
    sensors : mapping
        Arm -> how its sensor is simulated, for each arm with a sensor.
    """

    rate: int = 120
    sensors: Mapping[str, SimulatedSensor] = field(default_factory=dict)


def read_simulation(section: Section, with_sensor: Sequence[str]) -> Simulation:
    """Read the section, for the arms of the scene that have a sensor."""
    section.allow("rate", "sensors")
    rate = section.number("rate", 120)
    if rate != int(rate) or not 1 <= rate <= 1000:
        section.fail(f"{section.name}.rate = {rate:g}: must be a whole number of Hz in [1, 1000]", "rate")
    sections = section.section("sensors")
    sections.allow(*with_sensor)
    sensors = {name: _sensor(sections.section(name)) for name in with_sensor}
    return Simulation(int(rate), sensors)


def read_sensor_groups(root: Section) -> TacTipSettings:
    """The settings of a sensor file (`tactile_sim.collection`) without those of data sets."""
    default = TacTipSettings()
    root.allow("description", *_SENSOR_GROUPS, *_DATA_GROUPS)
    given = [name for name in _SENSOR_GROUPS if name in root.values]
    return replace(default, **{name: root.settings(name, type(getattr(default, name))) for name in given})


def _sensor(section: Section) -> SimulatedSensor:
    section.allow("fidelity", *(name for name in FIDELITIES if name != INPUT), *_FAULTS)
    delay = section.number("delay", 0.0)
    if not 0.0 <= delay <= LARGEST_DELAY:
        section.fail(f"{section.name}.delay = {delay:g} s: must lie in [0, {LARGEST_DELAY:g}]", "delay")
    in_tool: tuple[float, ...] = ()
    if "in_tool" in section.values:
        pose, none = section.section("in_tool"), (0.0, 0.0, 0.0)
        pose.allow("position", "rotation_deg")
        turn = tuple(map(math.radians, pose.numbers("rotation_deg", 3, none)))
        in_tool = pose.numbers("position", 3, none) + turn
    return replace(_of_fidelity(section), delay=delay, in_tool=in_tool)


def _of_fidelity(section: Section) -> SimulatedSensor:
    fidelity = section.choice("fidelity", FIDELITIES, "image")
    kind = MODELS[fidelity]
    if issubclass(kind, IdealSensorSettings):
        return SimulatedSensor(section.settings(fidelity, kind))
    return SimulatedSensor(_image_model(section.section("image")), fidelity == INPUT)


def _image_model(groups: Section) -> TacTipSettings:
    """The sensor file that `file` names, or the defaults, with the groups that are given."""
    groups.allow("file", *_SENSOR_GROUPS)
    base, changed = TacTipSettings(), {}
    if "file" in groups.values:
        try:
            base = read_sensor_groups(read_yaml(named_file("sensor", groups.text("file"))))
        except (FileNotFoundError, SettingError) as error:
            groups.fail(str(error), "file")
    for name in _SENSOR_GROUPS:
        if name in groups.values:
            group, settings = groups.section(name), getattr(base, name)
            changed[name] = group.checked(type(settings), {**asdict(settings), **group.values})
    return replace(base, **changed)
