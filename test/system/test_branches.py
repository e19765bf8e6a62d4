"""Runs that go on from a common beginning are those that were run from the start, to the bit."""

import numpy as np
import pytest
from branches import branch

from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_doubles.lying_arm import LyingArm
from tactile_doubles.lying_camera import ImageLies
from tactile_doubles.lying_estimates import LYING_ESTIMATES


def estimates(name, begins, arm):
    return LYING_ESTIMATES[name](begins, arm)


@pytest.mark.parametrize(
    "fidelity, make, arguments",
    [
        ("ideal", estimates, ("frozen", 2.5, "arm")),
        ("ideal", LyingArm, ("flipped_y", 2.5)),
        ("image", ImageLies, ("replayed", 2.5)),
    ],
)
def test_a_run_that_goes_on_from_a_beginning_is_the_one_from_the_start(fidelity, make, arguments):
    lies, records = branch("plane", "surface_following", fidelity, 2.5, make, *arguments)
    direct = make(*arguments)
    whole = run_arms_offline("plane", options=OfflineOptions(fidelity=fidelity, lies=direct))
    assert records["arm"].result["reason"] == whole["arm"].result["reason"]
    np.testing.assert_array_equal(records["arm"].command.twist, whole["arm"].command.twist)
    np.testing.assert_array_equal(records["arm"].truth.T_fs, whole["arm"].truth.T_fs)
    assert vars(lies.witness["arm"]).keys() == vars(direct.witness["arm"]).keys()
    assert lies.witness["arm"].way == direct.witness["arm"].way
