"""The double of an arm of a scene, by hand: it stands where the arm starts, at the address that `host` says.

In a terminal it takes what may go wrong, a line each, and prints its answer::

    python -m tactile_doubles my_cell.yaml
    protective_stop

For a `host` that this machine has: 127.0.0.2, for instance. A line that means nothing is answered with those
that mean something.
"""

from __future__ import annotations

import argparse
import sys

from tactile_base.settings import SettingError, unknown_name
from tactile_doubles.rehearsal import DOUBLES, doubled
from tactile_scene.scene import ArmScene
from tactile_scene.scene_file import load_scene


def arm_of(scene: str, name: str) -> ArmScene:
    """The arm of that name, or the only one that has a double; raises `SettingError`."""
    arms = {each: arm for each, arm in load_scene(scene).arms.items() if doubled(arm)}
    if name and name not in arms:
        raise SettingError(f"{scene}: arms with a double: {unknown_name(name, list(arms))}")
    if not name and len(arms) != 1:
        raise SettingError(f"{scene}: {len(arms)} arms have a double; say with --arm which one it is to be")
    return arms[name] if name else next(iter(arms.values()))


def main() -> int:
    """Serve until standard input ends; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", help="scene, or a scene file")
    parser.add_argument("--arm", default="", help="which arm (default: the only one with a driver)")
    arguments = parser.parse_args()
    try:
        arm = arm_of(arguments.scene, arguments.arm)
        double = DOUBLES.load(arm.driver)(arm)
    except (SettingError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    print(f"the double of '{arm.name}' listens at {arm.driver_settings.values.get('host')}", flush=True)
    try:
        for line in sys.stdin:
            print(double.ask(line.strip()), flush=True)
    except KeyboardInterrupt:
        pass
    finally:
        double.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
