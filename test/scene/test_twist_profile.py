"""Profiles that live as long as their process."""

import subprocess
import sys

import numpy as np

from tactile_scene.arm_settings import ArmLimits
from tactile_scene.twist_profile import TwistProfile

KEPT = """\
import threading, time
import numpy as np
from tactile_scene.arm_settings import ArmLimits
from tactile_scene.twist_profile import TwistProfile

def moves():
    profile = TwistProfile(ArmLimits())
    while True:
        profile.advance(0.01, np.full(6, 0.01))
        time.sleep(0.001)

threading.Thread(target=moves, daemon=True).start()
time.sleep(0.1)
"""


def test_a_profile_that_a_thread_still_uses_when_the_process_ends_leaves_nothing_in_its_log():
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", KEPT], capture_output=True, text=True, check=True)
        assert done.stdout + done.stderr == ""


def test_a_profile_that_was_released_rests():
    profile = TwistProfile(ArmLimits())
    profile.advance(0.01, np.full(6, 0.01))
    profile.release()
    assert not profile.advance(0.01, np.full(6, 0.01)).any()
