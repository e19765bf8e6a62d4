"""How the sensor is turned in the tool, from constructed contacts; refused where they do not tell it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tactile_records.calibrating import mounting
from tactile_records.calibrating.mounting import Contact
from tactile_records.calibrating.result import CalibrationError

angles = st.floats(-12.0, 12.0)
TILTS = [(0, 0), (16, 0), (6, 6), (0, 16), (-6, 6), (-16, 0), (-6, -6), (0, -16), (6, -6)]
NONE = np.zeros((0, 2))


def contacts(turn_deg, noise_deg=0.0, tilts=TILTS, moves=True, scale=1.3, seed=0):
    """What an arm and a network say of contacts, with a sensor that is turned by a rotation vector."""
    random = np.random.default_rng(seed)
    R = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    found = []
    for tilt in tilts:
        said = Rotation.from_rotvec([*tilt, 0.0], degrees=True).as_matrix()[2]
        error = Rotation.from_rotvec(noise_deg * random.normal(size=3), degrees=True).as_matrix()
        moved = felt = NONE
        if moves and tilt == (0, 0):
            along = 0.0015 * np.sin(np.linspace(0.0, 2.0 * np.pi, 30))
            moved = np.concatenate([np.stack([along, 0 * along], 1), np.stack([0 * along, along], 1)])
            felt = scale * (np.column_stack([moved, np.zeros(60)]) @ R @ error)[:, :2]
        found.append(Contact(said, error @ R.T @ said, moved, felt))
    return tuple(found)


@settings(max_examples=30, deadline=None)
@given(
    turn=st.tuples(angles, angles, st.floats(-60.0, 60.0)),
    noise=st.floats(0.0, 0.7),
    moves=st.booleans(),
    scale=st.floats(0.3, 2.0),
    seed=st.integers(0, 1000),
)
def test_a_rotation_is_found_again_within_its_uncertainty(turn, noise, moves, scale, seed):
    found = mounting.estimated(contacts(turn, noise, moves=moves, scale=scale, seed=seed))
    off = Rotation.from_rotvec(turn, degrees=True).inv() * Rotation.from_rotvec(found.rotation)
    assert off.magnitude() < 5.0 * np.linalg.norm(found.sigma)
    assert np.degrees(found.sigma).max() < 3.0
    if noise == 0.0:
        assert off.magnitude() < np.radians(0.3)  # a motion along the surface is taken for one along x and y


def test_motions_in_upright_contacts_tell_the_turn_about_the_axis_alone():
    upright = [(0, 0)] * 3 + [(3, 0), (-2, 2), (0, -3)]
    found = mounting.estimated(contacts((1.0, -2.0, 5.0), 0.1, upright))
    np.testing.assert_allclose(np.degrees(found.rotation), [1.0, -2.0, 5.0], atol=0.3)
    assert len(found.motion_residuals) == 3


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (contacts((1, 2, 3))[:2], "2 contacts: must be at least 3"),
        (contacts((1, 2, 3), tilts=[(0, 0)] * 4, moves=False), "press under at least three tilts"),
        (
            contacts((1, 2, 3), noise_deg=12.0),
            "degrees off what any mounting explains, must be at most 6",
        ),
    ],
)
def test_contacts_that_do_not_tell_a_rotation_are_refused_with_what_would(given, words):
    with pytest.raises(CalibrationError, match=words):
        mounting.estimated(given)
