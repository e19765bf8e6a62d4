"""The pushed objects of `sim/pushed.py` beside MuJoCo: the same push of a box and a disc by a compliant ball.

MuJoCo is no dependency of the project. This runs in an environment of its own, on numbers that
bench/pushed_objects.py writes, so that neither has to import the other's packages::

    python bench/pushed_objects.py --way /tmp/way.json
    python -m venv /tmp/mujoco && /tmp/mujoco/bin/pip install mujoco
    /tmp/mujoco/bin/python bench/pushed_objects_mujoco.py /tmp/way.json

The ball hangs on springs with the skin's stiffness from a point that goes the same way as the sensor; the
object stands on a plane with many small feet.
"""

from __future__ import annotations

import json
import sys
import time

import mujoco
import numpy as np

MODEL = """
<mujoco>
  <option timestep="{dt}" cone="elliptic" impratio="10" integrator="implicitfast" iterations="100"/>
  <default><geom solref="{stiff} 1" solimp="0.99 0.999 0.001"/></default>
  <worldbody>
    <geom type="plane" size="2 2 0.1" friction="{friction} 0 0" priority="1" contype="2" conaffinity="2"/>
    <body pos="{x} {y} {half}">
      <freejoint/>
      <geom type="{shape}" size="{size}" mass="{mass}"/>
      {feet}
    </body>
    <body pos="{sx} {sy} {sz}" gravcomp="1">
      <joint type="slide" axis="1 0 0" stiffness="{across}" damping="{damping}"/>
      <joint type="slide" axis="0 1 0" stiffness="{along}" damping="{damping}"/>
      <joint type="slide" axis="0 0 1" stiffness="{across}" damping="{damping}"/>
      <geom type="sphere" size="0.02" mass="0.01" friction="{tip} 0 0" priority="2"/>
    </body>
  </worldbody>
</mujoco>
"""
FOOT = '<geom type="sphere" size="0.002" pos="{x} {y} {z}" mass="1e-6" contype="2" conaffinity="2"/>'
FEET = 7  # along each side: an even pressure, where a box would stand on its corners alone


def feet(case: dict) -> str:
    """Small balls under the object, spread evenly."""
    half = np.array(case["half"])
    at = (2 * np.arange(FEET) + 1) / FEET - 1
    grid = [
        (x * half[0], y * half[1]) for x in at for y in at if case["shape"] == "box" or np.hypot(x, y) < 1
    ]
    return "".join(FOOT.format(x=x, y=y, z=0.002 - half[2]) for x, y in grid)


def run(case: dict, dt: float) -> tuple[np.ndarray, float]:
    """Object's x, y (m) and turn (rad) where the case has them, and seconds of computing."""
    half = case["half"]
    size = f"{half[0]} {half[1]} {half[2]}" if case["shape"] == "box" else f"{half[0]} {half[2]}"
    sensor = np.array(case["sensor"])
    model = mujoco.MjModel.from_xml_string(MODEL.format(
        dt=dt, stiff=2 * dt, friction=case["friction"], mass=case["mass"], shape=case["shape"], size=size,
        half=half[2], feet=feet(case), x=case["object"][0][0], y=case["object"][0][1],
        sx=sensor[0, 0], sy=sensor[0, 1], sz=case["height"],
        along=case["along"], across=case["across"], damping=case["damping"], tip=case["friction_tip"],
    ))  # fmt: skip
    data = mujoco.MjData(model)
    rest = sensor[0]
    stamps, places = np.array(case["time"]), []
    begun = time.process_time()
    for stamp in stamps:
        while data.time < stamp:
            way = [np.interp(data.time, stamps, sensor[:, axis]) for axis in range(2)]
            # the springs pull to where the sensor is: the same as joints on a body that moves
            model.qpos_spring[7:9] = way - rest
            mujoco.mj_step(model, data)
        w, _, _, z = data.qpos[3:7]
        places.append([data.qpos[0], data.qpos[1], 2 * np.arctan2(z, w)])
    return np.array(places), time.process_time() - begun


def main() -> None:
    with open(sys.argv[1]) as file:
        cases = json.load(file)
    print("case, dt ms: off at the end x mm, y mm, turn deg; us a simulated step of 1/120 s (ours; MuJoCo)")
    for case in cases:
        ours = np.array(case["object"])
        for dt in (2e-3, 5e-4):
            theirs, seconds = run(case, dt)
            off = theirs[-1] - ours[-1]
            turned = np.degrees(ours[-1, 2])
            each = 1e6 * seconds / (case["time"][-1] * 120)
            print(f"  {case['name']:28} {1e3 * dt:4.1f}: {1e3 * off[0]:6.2f} {1e3 * off[1]:6.2f} "
                  f"{np.degrees(off[2]):6.2f} of {turned:6.1f}; "
                  f"{case['step_us']:6.0f} {each:6.0f}")  # fmt: skip


if __name__ == "__main__":
    main()
