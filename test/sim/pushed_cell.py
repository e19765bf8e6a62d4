"""An object on a floor, tips before it that push, and where it goes."""

import numpy as np

from tactile_scene.scene_file import load_scene

SPEED = 0.01  # m/s
STIFF = {"skin_force": 8.45, "skin_shear": 1053.0}

SCENE = """
arms:
{arms}
bodies:
  pushed:
    {shape}
    pose: {{position: [{x}, {y}, {z}], rotation_deg: [0, 0, {turn}]}}
    motion: pushed
    motion_settings: {{mass: 0.479, {settings}}}
simulation:
  sensors:
{sensors}
"""
ARM = """  {name}:
    driver: sim
    start: {{position: [{x}, -0.021, {height}], rotation_deg: [0, 90, 90]}}
    sensor: {{camera_rate: 60}}
"""
SENSOR = "    {name}: {{fidelity: ideal, ideal: {{sigma_position: [0, 0, 0], sigma_rotation: [0, 0, 0]}}}}\n"
BOX = "shape: box\n    parameters: {size: [0.08, 0.08, 0.06], rounding: 0.0}"
DISC = "shape: cylinder\n    parameters: {radius: 0.04, height: 0.06}"


def scene(tmp_path, tips=(0.0,), shape=BOX, at=(0.0, 0.04), turn=0.0, height=0.022, **settings):
    """Tips at x on the line y = -1 mm, pointing along y, and an object of 40 mm half width before them."""
    names = [f"tip{k}" for k in range(len(tips))]
    settings = {"friction": 0.1, **STIFF, **settings}
    text = SCENE.format(
        arms="".join(ARM.format(name=n, x=x, height=height) for n, x in zip(names, tips, strict=True)),
        sensors="".join(SENSOR.format(name=n) for n in names),
        shape=shape, x=at[0], y=at[1], z=0.03, turn=turn,
        settings=", ".join(f"{key}: {list(v) if isinstance(v, tuple) else v}" for key, v in settings.items()),
    )  # fmt: skip
    path = tmp_path / "push.yaml"
    path.write_text(text)
    return load_scene(path)


def push(cell, seconds, velocity=(0.0, SPEED), until=None):
    """All tips go with a velocity in the world; the frames of the first."""
    frames = []
    end_ns = cell.stamp_ns + round(seconds * 1e9)
    while cell.stamp_ns < end_ns and not (until and until(cell)):
        for arm in cell.arms:
            # {s}: z along the world's y, x down, y along the world's -x
            cell.command(arm, cell.stamp_ns, [0, -velocity[0], velocity[1], 0, 0, 0])
        cell.step()
        for arm in cell.arms:
            if cell.exposure_due(arm):
                frame = cell.expose(arm)
                frames += [frame] if arm == cell.arms[0] else []
    return frames


def place(cell):
    """x, y (m) and turn (rad) of the object."""
    T = cell.T_world_body("pushed")
    return np.array([*T[:2, 3], np.arctan2(T[1, 0], T[0, 0])])
