"""Settings of the simulated sensors, apart from what simulates them: reading a scene loads only these."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tactile_base.settings import SettingError, Settings, setting


@dataclass(frozen=True)
class SkinSettings(Settings):
    """Geometry and materials of the tip; the defaults are those of the file that is shipped."""

    radius: float = setting(0.020, unit="m", lower=1e-3, upper=0.1, doc="outer radius of the tip")
    skin_thickness: float = setting(0.001, unit="m", lower=1e-4, upper=5e-3, doc="of the stiff skin")
    gel_modulus: float = setting(8.0e3, unit="Pa", lower=1.0, upper=1e9, doc="Young's modulus of the gel")
    stiffness_ratio: float = setting(8.0, lower=0.1, upper=1e3, doc="modulus of the skin over the gel's")
    poisson_ratio: float = setting(0.3, lower=0.0, upper=0.49, doc="Poisson's ratio of gel and skin")
    volume_retention: float = setting(
        0.0, lower=0.0, upper=0.999,
        doc="part of the volume change that pressure inside takes back: 1 for a gel that keeps its volume",
    )  # fmt: skip
    rings: int = setting(14, lower=4, upper=24, doc="rings of skin nodes; the last is clamped")
    shells: tuple[float, ...] = setting(
        (0.875, 0.75, 0.6, 0.425, 0.225), lower=0.05, upper=0.95,
        doc="radii of the gel's shells below the skin, relative to the outer radius, falling",
    )  # fmt: skip


@dataclass(frozen=True)
class ContactSettings(Settings):
    """Friction, and accuracy against time."""

    friction: float = setting(0.9, lower=0.0, upper=5.0, doc="Coulomb friction between skin and surface")
    friction_load: float = setting(
        0.0, unit="N", lower=0.0, upper=100.0,
        doc="normal force at which friction has half its value, which it approaches with load; 0: always",
    )  # fmt: skip
    max_step: float = setting(2e-4, unit="m", lower=1e-6, upper=2e-3, doc="longest motion solved in one step")
    max_sweeps: int = setting(30, lower=1, upper=10000, doc="Gauss-Seidel sweeps a step, at most")
    tolerance: float = setting(1e-6, unit="m", lower=1e-12, upper=1e-3, doc="motion that ends the sweeps")
    margin: float = setting(5e-4, unit="m", lower=0.0, upper=5e-3, doc="gap at which a node enters")


@dataclass(frozen=True)
class MarkerSettings(Settings):
    """Layout of the markers: rings of 1, 6, 12, ... about the tip's axis."""

    rings: int = setting(
        10, lower=0, upper=13, doc="rings about the central marker; 10 make 331 markers, 0 none at all"
    )
    pitch_deg: float = setting(6.32, unit="deg", lower=1.0, upper=8.0, doc="polar angle between rings")
    azimuth_deg: float = setting(
        51.8, lower=-360.0, upper=360.0, unit="deg", doc="of each ring's first marker about z of {s}"
    )
    pin_length: float = setting(0.002, unit="m", lower=0.0, upper=0.01, doc="from the skin to the marker")
    worn: float = setting(
        0.0, lower=0.0, upper=0.9, doc="part of the pins that are worn off, always the same ones"
    )


@dataclass(frozen=True)
class CameraSettings(Settings):
    """Optics and gray levels; the defaults resemble a published TacTip (docs/simulator.md)."""

    width: int = setting(640, unit="px", lower=16, upper=4096, doc="image width")
    height: int = setting(480, unit="px", lower=16, upper=4096, doc="image height")
    center_column: float = setting(
        330.4, lower=-4096.0, upper=8192.0, unit="px", doc="column of the optical axis"
    )
    center_row: float = setting(241.6, lower=-4096.0, upper=8192.0, unit="px", doc="row of the optical axis")
    focal_length: float = setting(896.0, unit="px", lower=1.0, upper=100000.0, doc="focal length")
    distance: float = setting(
        0.0653, unit="m", lower=1e-3, upper=1.0, doc="from the pinhole to the dome's centre"
    )
    distortion: tuple[float, ...] = setting(
        (1.0, 0.0), lower=-100.0, upper=100.0, length=2,
        doc="k1, k2 of r = f q (1 + k1 q^2 + k2 q^4), q = tan of the angle to the axis",
    )  # fmt: skip
    rotation_deg: float = setting(
        -52.9, lower=-360.0, upper=360.0, unit="deg", doc="{s}'s x axis in the image, from right to down"
    )
    marker_radius: float = setting(0.0005, unit="m", lower=0.0, upper=0.005, doc="radius of a marker")
    marker_perspective: float = setting(
        1.0, lower=0.0, upper=1.0, doc="exponent of a marker's size over its scale: 1 as seen, 0 all alike"
    )
    marker_gray: float = setting(190.0, lower=0.0, upper=255.0, doc="gray level of a marker in the middle")
    ground_gray: float = setting(6.0, lower=0.0, upper=255.0, doc="gray level between the markers there")
    vignette: float = setting(0.35, lower=0.0, upper=1.0, doc="part of the brightness lost in the corners")
    edge_width: float = setting(2.5, unit="px", lower=0.1, upper=50.0, doc="over which a marker's edge fades")
    gain: float = setting(1.0, lower=0.0, upper=10.0, doc="factor on all gray levels")
    noise_gray: float = setting(2.0, lower=0.0, upper=50.0, doc="standard deviation of the pixel noise")


@dataclass(frozen=True)
class LightSettings(Settings):
    """Red, green and blue lamps at the rim, which light the inside of the skin; images are in color then."""

    lamp_gray: float = setting(
        0.0, lower=0.0, upper=255.0,
        doc="level that a lamp gives to skin that faces it a radius away; 0: no lamps, gray images",
    )  # fmt: skip
    ambient_gray: float = setting(20.0, lower=0.0, upper=255.0, doc="level of each color without its lamp")
    azimuth_deg: float = setting(
        90.0,
        lower=-360.0,
        upper=360.0,
        unit="deg",
        doc="of the red lamp about z of {s}; green 120 on, blue 240",
    )


@dataclass(frozen=True)
class TacTipSettings:
    """All of the sensor: tip, contact, markers, camera and light."""

    skin: SkinSettings = field(default_factory=SkinSettings)
    contact: ContactSettings = field(default_factory=ContactSettings)
    markers: MarkerSettings = field(default_factory=MarkerSettings)
    camera: CameraSettings = field(default_factory=CameraSettings)
    light: LightSettings = field(default_factory=LightSettings)


@dataclass(frozen=True)
class IdealSensorSettings(Settings):
    """Noise and shear of the ideal sensor.

    The noise has the mean absolute errors of the paper's GDN on its test data (for a Gaussian, the standard
    deviation over 1.2533). Shear slips where that of the simulated TacTip does at friction
    0.9.
    """

    radius: float = setting(0.020, unit="m", lower=1e-3, upper=0.1, doc="radius of the hemispherical tip")
    sigma_position: tuple[float, ...] = setting(
        (0.534e-3, 0.529e-3, 0.154e-3),
        unit="m",
        lower=0.0,
        upper=0.1,
        length=3,
        doc="standard deviation of rho",
    )
    sigma_rotation: tuple[float, ...] = setting(
        (0.0109, 0.0139, 0.0254), unit="rad", lower=0.0, upper=1.0, length=3, doc="standard deviation of phi"
    )
    shear_depths: tuple[float, ...] = setting(
        (0.0, 0.5e-3, 1e-3, 2e-3, 3e-3, 4e-3, 5e-3), unit="m", lower=0.0, upper=0.1, doc="of the limits below"
    )
    shear_limits: tuple[float, ...] = setting(
        (0.0, 0.39e-3, 0.88e-3, 2.18e-3, 3.77e-3, 5.68e-3, 7.88e-3),
        unit="m",
        lower=0.0,
        upper=0.1,
        doc="shear at which the contact slips",
    )
    turn_limits: tuple[float, ...] = setting(
        (0.0, 0.034, 0.070, 0.136, 0.197, 0.253, 0.317),
        unit="rad",
        lower=0.0,
        upper=1.0,
        doc="turn at which the contact slips",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = len(self.shear_depths)
        if not rows or any(len(table) != rows for table in (self.shear_limits, self.turn_limits)):
            raise SettingError("shear_depths, shear_limits and turn_limits must be of one length, at least 1")
        if any(np.diff(self.shear_depths) <= 0):
            raise SettingError(f"shear_depths = {self.shear_depths}: must increase")


@dataclass(frozen=True)
class FittedSensorSettings(IdealSensorSettings):
    """Contact and shear of the ideal sensor; its noise, on top of the errors of the network, is zero."""

    sigma_position: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), unit="m", lower=0.0, upper=0.1, length=3,
        doc="standard deviation of rho on top of the network's errors",
    )  # fmt: skip
    sigma_rotation: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), unit="rad", lower=0.0, upper=1.0, length=3,
        doc="standard deviation of phi on top of the network's errors",
    )  # fmt: skip
