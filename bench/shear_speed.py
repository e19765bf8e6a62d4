"""A speed that the shear limits, on a sticky surface: the paper's "potentially useful extension", measured.

    python bench/shear_speed.py

A tip slides over a plane at 10 mm/s, as in surface following, at depths of 2 to 4 mm, on surfaces one to
three times as sticky as what the ideal sensor's limits of shear are of. Its shear grows with the way until it
slips. A proportional controller takes the speed down as the believed shear passes a safe one. Friction is
that of the simulation, the same at all speeds, or one that grows with a power of the speed, as that of rubber
can.
"""

from __future__ import annotations

import numpy as np

from tactile_scene.simulated_sensors import IdealSensorSettings

TRIALS, SECONDS, DT, SPEED = 200, 12.0, 1.0 / 60.0, 0.010
SAFE = 0.003  # m
SENSOR = IdealSensorSettings()


def slide(limited: bool, exponent: float) -> tuple[float, float, float]:
    """Mean of the largest shear (mm) and of the way (mm), and the part of trials that nearly stand still."""
    rng = np.random.default_rng(0)
    depth, sticky = rng.uniform(0.002, 0.004, TRIALS), rng.uniform(1.0, 3.0, TRIALS)
    slips_at = sticky * np.interp(depth, SENSOR.shear_depths, SENSOR.shear_limits)
    shear, largest, way, speed = (np.zeros(TRIALS) for _ in range(4))
    for _ in range(int(SECONDS / DT)):
        noise = 0.25 * SENSOR.sigma_position[0] * rng.standard_normal(TRIALS)
        slower = np.clip(2.0 - (shear + noise) / SAFE, 0.0, 1.0) if limited else np.ones(TRIALS)
        speed = SPEED * slower
        limit = slips_at * (np.maximum(speed, 1e-5) / SPEED) ** exponent
        shear = np.minimum(shear + speed * DT, limit)
        largest, way = np.maximum(largest, shear), way + speed * DT
    return 1e3 * largest.mean(), 1e3 * way.mean(), float((speed < 0.1 * SPEED).mean())


def main() -> None:
    """Print the table."""
    print(f"{TRIALS} trials each, {SECONDS:g} s\n")
    print("| friction | speed | largest shear [mm] | way [mm] | stand still |")
    print("| --- | --- | ---: | ---: | ---: |")
    for friction, exponent in (("the same at all speeds", 0.0), ("grows as speed^0.3", 0.3)):
        for name, limited in (("10 mm/s", False), ("limited by shear", True)):
            shear, way, still = slide(limited, exponent)
            print(f"| {friction} | {name} | {shear:.2f} | {way:.0f} | {100 * still:.0f} % |")


if __name__ == "__main__":
    main()
