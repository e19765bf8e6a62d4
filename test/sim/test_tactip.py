"""The simulated TacTip: contact mechanics with history, truth, and images."""

import cv2
import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_scene.shapes import make_surface
from tactile_scene.simulated_sensors import (
    CameraSettings,
    ContactSettings,
    MarkerSettings,
    SkinSettings,
    TacTipSettings,
)
from tactile_sim.collection import press_then_shear
from tactile_sim.skin import Skin, build_skin, load_skin
from tactile_sim.tactip import TacTip

RADIUS = SkinSettings().radius
FACING_DOWN = se3.pose_from_euler([0.0, 0.0, RADIUS, np.pi, 0.0, 0.0])  # {f} over the plane z = 0


def pose(
    x: float = 0, y: float = 0, z: float = 0, alpha: float = 0, beta: float = 0, gamma: float = 0
) -> np.ndarray:
    """Sensor in the plane's frame for a surface contact pose in mm and degrees."""
    return FACING_DOWN @ se3.pose_from_euler([*np.array([x, y, z]) * 1e-3, *np.radians([alpha, beta, gamma])])


@pytest.fixture(scope="module")
def skin() -> Skin:
    return load_skin()


@pytest.fixture(scope="module")
def plane():
    return make_surface("plane", {})


@pytest.fixture
def sensor(skin) -> TacTip:
    return TacTip(seed=3, skin=skin)


def shear_of(sensor: TacTip) -> np.ndarray:
    """Equivalent x, y (mm) and gamma (deg)."""
    x, y, _, _, _, gamma = se3.euler_from_pose(sensor.truth().T_fs)
    return np.array([x * 1e3, y * 1e3, np.degrees(gamma)])


def pressed(sensor: TacTip, plane, depth: float, **at: float) -> TacTip:
    sensor.reset()
    sensor.advance(plane, pose(z=-1, **at))
    sensor.advance(plane, pose(z=depth, **at))
    return sensor


def saturated_shear(sensor: TacTip, plane, depth: float) -> float:
    pressed(sensor, plane, depth).advance(plane, pose(x=10, z=depth))
    return float(shear_of(sensor)[0])


def test_nothing_is_felt_off_the_surface(sensor, plane):
    sensor.advance(plane, pose(z=-0.01))
    truth = sensor.truth()
    assert truth.contact_nodes == 0 and truth.normal_force == 0 and truth.slip_fraction == 0
    assert truth.depth == pytest.approx(-1e-5, abs=1e-12)
    assert np.allclose(truth.T_fs[:3, :3], np.eye(3), atol=1e-12) and np.all(truth.T_fs[:2, 3] == 0)


def test_depth_and_angles_of_the_truth_are_those_of_the_pose(sensor, plane):
    pressed(sensor, plane, 3.0, alpha=14.0, beta=-9.0)
    x, y, z, alpha, beta, gamma = se3.euler_from_pose(sensor.truth().T_fs)
    assert z == pytest.approx(3e-3, abs=1e-9)
    assert np.degrees([alpha, beta]) == pytest.approx([14.0, -9.0], abs=1e-6)
    assert abs(x) < 2e-4 and abs(y) < 2e-4 and abs(np.degrees(gamma)) < 0.2


@pytest.mark.parametrize(
    "shear", [(0.5, 0, 0), (0, -0.5, 0), (0.3, 0.4, 0), (0, 0, 2.0), (-0.4, 0.2, -1.5)], ids=str
)
def test_shear_is_the_commanded_one_while_the_contact_sticks(sensor, plane, shear):
    pressed(sensor, plane, 4.0)
    before = shear_of(sensor)
    sensor.advance(plane, pose(*shear[:2], 4.0, gamma=shear[2]))
    assert sensor.truth().slip_fraction < 0.15
    assert shear_of(sensor) - before == pytest.approx(shear, abs=0.05)


def test_shear_saturates_and_the_deeper_the_later(sensor, plane):
    levels = [saturated_shear(sensor, plane, depth) for depth in (0.5, 1.0, 2.0, 3.0)]
    assert levels == sorted(levels)
    assert 0.2 < levels[0] < 0.7 and 0.6 < levels[1] < 1.3 and 1.5 < levels[2] < 3.0 and 2.7 < levels[3] < 5.0
    truth = sensor.truth()
    assert truth.slip_fraction == pytest.approx(1.0)
    assert truth.tangential_force == pytest.approx(sensor.friction * truth.normal_force, rel=0.01)


def test_shear_in_steady_sliding_no_longer_changes(sensor, plane):
    pressed(sensor, plane, 2.0).advance(plane, pose(x=10, z=2))
    first = shear_of(sensor)
    sensor.advance(plane, pose(x=20, z=2))
    assert shear_of(sensor) == pytest.approx(first, abs=0.01)


def test_without_friction_there_is_no_tangential_force(sensor, plane):
    sensor.friction = 0.0
    pressed(sensor, plane, 2.0).advance(plane, pose(x=3, z=2))
    truth = sensor.truth()
    assert truth.normal_force > 0.05 and truth.tangential_force < 1e-9


def test_normal_force_grows_with_depth(sensor, plane):
    forces = []
    for depth in np.arange(-0.2, 6.01, 0.2):
        sensor.advance(plane, pose(z=depth))
        forces.append(sensor.truth().normal_force)
    assert forces[0] == 0.0
    assert np.all(np.diff(forces[2:]) > 0)


def test_the_surface_never_pulls_and_is_not_entered(sensor, plane):
    rng = np.random.default_rng(0)
    sensor.advance(plane, pose(z=0))
    for _ in range(30):
        at = rng.uniform([-3, -3, -0.5, -20, -20, -5], [3, 3, 5, 20, 20, 5])
        sensor.advance(plane, pose(*at))
        state = sensor._contact_state()
        assert np.all(np.einsum("ij,ij->i", state.force, state.normal) >= 0)
        T = pose(*at)
        heights = ((sensor._skin.nodes + sensor.displacement) @ T[:3, :3].T + T[:3, 3])[:, 2]
        assert heights.min() > -2e-5


def test_friction_force_stays_in_its_cone(sensor, plane):
    pressed(sensor, plane, 3.0, alpha=10).advance(plane, pose(2, -1, 3, alpha=10, gamma=4))
    state = sensor._contact_state()
    press = np.einsum("ij,ij->i", state.force, state.normal)
    tangent = np.linalg.norm(state.force - press[:, None] * state.normal, axis=1)
    assert np.all(tangent <= sensor.friction * press + 1e-12)


def test_the_path_matters(sensor, plane):
    pressed(sensor, plane, 2.0)
    straight = sensor.marker_positions
    sensor.advance(plane, pose(x=5, z=2))
    sensor.advance(plane, pose(z=2))
    there_and_back = shear_of(sensor)[0]
    assert there_and_back < -1.0  # slipped on the way out, so that it is dragged on the way home
    assert np.abs(sensor.marker_positions - straight).max() > 5e-4


def test_pressing_after_moving_shows_no_shear(sensor, plane):
    sensor.advance(plane, pose(x=0, z=-1))
    sensor.advance(plane, pose(x=5, z=-1))
    sensor.advance(plane, pose(x=5, z=2))
    assert np.abs(shear_of(sensor)).max() < 0.05


def test_lift_off_returns_the_skin_to_rest(sensor, plane):
    rest = sensor.marker_positions
    pressed(sensor, plane, 5.0).advance(plane, pose(x=3, z=5))
    sensor.advance(plane, pose(x=3, z=-3))
    assert sensor.truth().contact_nodes == 0
    assert np.abs(sensor.displacement).max() == 0
    assert np.array_equal(sensor.marker_positions, rest)


def test_a_turn_of_sensor_and_motion_turns_the_answer(sensor, plane):
    """By 60 degrees, the symmetry of the mesh and of the marker rings."""
    pressed(sensor, plane, 3.0)
    sensor.advance(plane, pose(x=1.5, z=3.0))
    markers, force = sensor.marker_positions, sensor.truth().force
    turn = se3.pose_from_euler([0, 0, 0, 0, 0, np.pi / 3])[:3, :3]
    pressed(sensor, plane, 3.0)
    sensor.advance(plane, pose(x=1.5 * np.cos(np.pi / 3), y=1.5 * np.sin(np.pi / 3), z=3.0))
    assert sensor.truth().force == pytest.approx(turn @ force, abs=1e-3)
    turned = markers @ turn.T
    nearest = np.linalg.norm(turned[:, None] - sensor.marker_positions, axis=2).min(axis=1)
    assert nearest.max() < 2e-5


def test_where_the_plane_stands_in_the_world_does_not_matter(sensor, plane):
    pressed(sensor, plane, 3.0, alpha=8).advance(plane, pose(1, 1, 3, alpha=8))
    markers = sensor.marker_positions
    slide = se3.pose_from_euler([0.03, -0.02, 0, 0, 0, 2.0])  # maps the plane onto itself
    sensor.reset()
    for at in (pose(z=-1, alpha=8), pose(z=3, alpha=8), pose(1, 1, 3, alpha=8)):
        sensor.advance(plane, slide @ at)
    assert sensor.marker_positions == pytest.approx(markers, abs=1e-6)


def test_a_long_motion_is_split_into_steps(sensor, plane):
    pressed(sensor, plane, 3.0).advance(plane, pose(x=4, z=3))
    at_once = sensor.marker_positions
    pressed(sensor, plane, 3.0)
    for x in np.linspace(0, 4, 81)[1:]:
        sensor.advance(plane, pose(x=x, z=3))
    assert sensor.marker_positions == pytest.approx(at_once, abs=5e-5)


def test_contact_on_a_dome_is_narrower_than_on_a_plane(sensor, plane):
    dome = make_surface("dome", {})
    apex = dome.closest(np.array([[0.0, 0.0, 1.0]]))[0]
    for depth in (-1e-3, 3e-3):
        sensor.advance(dome, se3.pose_from_euler([apex[0], apex[1], apex[2] + RADIUS - depth, np.pi, 0, 0]))
    on_dome = sensor.truth()
    flat = pressed(sensor, plane, 3.0).truth()
    assert on_dome.depth == pytest.approx(flat.depth, abs=1e-9)
    assert 0 < on_dome.normal_force < flat.normal_force


@pytest.mark.parametrize(
    "bad, why",
    [
        (np.full((4, 4), np.nan), "not finite"),
        (np.eye(3), r"must be \(4, 4\)"),
        (np.diag([1.0, 1.0, 1.1, 1.0]), "not a rigid transform"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rigid transform"),
    ],
)
def test_a_bad_pose_is_refused_and_changes_nothing(sensor, plane, bad, why):
    pressed(sensor, plane, 2.0)
    before = sensor.marker_positions
    with pytest.raises(se3.PoseError, match=why):
        sensor.advance(plane, bad)
    assert np.array_equal(sensor.marker_positions, before)


def test_a_surface_that_answers_nan_is_named(sensor):
    class Broken:
        def query(self, points):
            return np.full(len(points), np.nan), np.zeros((len(points), 3))

    with pytest.raises(se3.PoseError, match="surface Broken"):
        sensor.advance(Broken(), pose(z=1))


def test_truth_before_the_first_pose_is_an_error(sensor):
    with pytest.raises(RuntimeError, match="before the first advance"):
        sensor.truth()


def test_friction_out_of_range_is_refused(sensor):
    with pytest.raises(SettingError, match="friction"):
        sensor.friction = -0.1


def test_the_image_without_contact_has_331_markers(sensor):
    image = sensor.image()
    assert image.shape == (480, 640) and image.dtype == np.uint8
    count, _, stats, _ = cv2.connectedComponentsWithStats((image > 60).astype(np.uint8))
    assert count - 1 == 331
    areas = stats[1:, cv2.CC_STAT_AREA]
    assert areas.min() > 50 and areas.max() < 250


def test_images_repeat_with_the_seed_and_differ_from_frame_to_frame(skin, plane):
    first, second, other = (TacTip(seed=seed, skin=skin) for seed in (1, 1, 2))
    for sensor in (first, second, other):
        press_then_shear(sensor, np.array([1e-3, 0, 2e-3, 0.1, 0, 0]))
    image = first.image()
    assert np.array_equal(image, second.image())
    assert not np.array_equal(image, other.image())
    assert not np.array_equal(image, first.image())
    first.reset(seed=1)
    press_then_shear(first, np.array([1e-3, 0, 2e-3, 0.1, 0, 0]))
    assert np.array_equal(first.image(), image)


def test_pixel_noise_has_the_standard_deviation_of_its_setting(skin):
    images = []
    for noise in (0.0, 4.0):
        camera = CameraSettings(noise_gray=noise, ground_gray=60.0)
        images.append(TacTip(TacTipSettings(camera=camera), skin=skin).image().astype(float))
    difference = images[1] - images[0]
    assert abs(difference.mean()) < 0.1
    assert difference.std() == pytest.approx(4.0, rel=0.03)


def test_a_tilted_contact_shows_on_the_side_that_touches(sensor, plane):
    """Markers near the contact are pushed towards the camera, so that they spread there."""
    rest = sensor.marker_positions
    pressed(sensor, plane, 2.0, beta=-20.0)  # the surface's inward normal leans to +x of {s}
    moved = rest[np.argmax(np.linalg.norm(sensor.marker_positions - rest, axis=1))]
    assert moved[0] > 4e-3 and abs(moved[1]) < 3e-3


def test_the_shipped_skin_is_what_its_command_builds():
    shipped, built = load_skin(), build_skin(SkinSettings())
    scale = np.abs(built.compliance).max()
    assert np.abs(shipped.compliance - built.compliance).max() < 1e-5 * scale


def test_a_skin_of_another_modulus_only_is_the_shipped_one_made_stiffer():
    settings = SkinSettings(gel_modulus=4.0e4)
    scaled, built = load_skin(settings), build_skin(settings)
    assert np.abs(scaled.compliance - built.compliance).max() < 1e-5 * np.abs(built.compliance).max()


def test_compliance_is_symmetric_and_positive(skin):
    matrix = skin.compliance.astype(float)
    assert np.array_equal(matrix, matrix.T)
    coarse = np.arange(0, len(matrix), 7)
    assert np.linalg.eigvalsh(matrix[np.ix_(coarse, coarse)]).min() > 0


def test_a_stiffer_skin_gives_way_less(skin):
    stiff = build_skin(SkinSettings(stiffness_ratio=30.0))
    assert stiff.compliance[2, 2] < 0.7 * skin.compliance[2, 2]


@pytest.mark.parametrize("retention", [0.5, 0.999])
def test_a_sealed_gel_takes_back_its_part_of_the_volume_pressed_in(skin, retention):
    """The volume under the displaced mesh, not the formula of the code under test."""
    held = load_skin(SkinSettings(volume_retention=retention))
    force = np.zeros(3 * len(skin.nodes))
    force[2] = -1e-3  # on the pole, inwards

    def lost(of: Skin) -> float:
        moved = of.nodes + (of.compliance @ force).reshape(-1, 3)
        corners = np.concatenate([moved, of.rim])[of.triangles]
        rest = np.concatenate([of.nodes, of.rim])[of.triangles]
        return float(np.sum(np.linalg.det(rest)) - np.sum(np.linalg.det(corners))) / 6

    assert lost(skin) > 0
    assert lost(held) / lost(skin) == pytest.approx(1 - retention, abs=0.01)
    assert np.array_equal(held.compliance, held.compliance.T)


def test_with_a_friction_load_light_contacts_slip_sooner(skin, plane):
    def part(depth: float, load: float) -> float:
        """Saturated shear, relative to that with the same friction at any load."""
        contact = ContactSettings(friction_load=load)
        rising = TacTip(TacTipSettings(contact=contact), skin=skin)
        return saturated_shear(rising, plane, depth) / saturated_shear(TacTip(skin=skin), plane, depth)

    light, heavy = part(1.0, 0.3), part(4.0, 0.3)
    assert light < 0.5 < 0.6 < heavy < 1.0


def test_markers_may_be_drawn_alike_whatever_their_distance():
    def areas(perspective: float) -> np.ndarray:
        camera = CameraSettings(marker_perspective=perspective, vignette=0.0, noise_gray=0.0)
        sensor = TacTip(TacTipSettings(camera=camera))
        image = sensor.image()
        _, _, stats, centers = cv2.connectedComponentsWithStats((image > 100).astype(np.uint8))
        radius = np.hypot(*(centers[1:] - centers[1:].mean(axis=0)).T)
        area = stats[1:, cv2.CC_STAT_AREA]
        return np.array([area[radius < 60].mean(), area[radius > 180].mean()])

    inner, outer = areas(0.0)
    assert outer == pytest.approx(inner, rel=0.03)
    inner, outer = areas(1.0)
    assert outer > 1.1 * inner


def test_shells_that_do_not_fall_are_refused():
    with pytest.raises(ValueError, match="must fall"):
        build_skin(SkinSettings(shells=(0.5, 0.7)))


def test_more_sweeps_and_smaller_steps_change_little(skin, plane):
    fine = ContactSettings(max_step=5e-5, max_sweeps=2000, tolerance=1e-9)
    markers = []
    for settings in (TacTipSettings(), TacTipSettings(contact=fine)):
        sensor = TacTip(settings, skin=skin)
        press_then_shear(sensor, np.array([3e-3, -1e-3, 3.5e-3, 0.2, -0.1, 0.05]))
        markers.append(sensor.marker_positions)
    assert np.abs(markers[1] - markers[0]).max() < 3e-5


def test_worn_pins_are_gone_and_the_others_where_they_were():
    whole, worn = TacTip(), TacTip(TacTipSettings(markers=MarkerSettings(worn=0.2)))
    here = {tuple(row) for row in whole.marker_positions.round(7)}
    assert 0.7 * len(here) < len(worn.marker_positions) < 0.9 * len(here)
    assert {tuple(row) for row in worn.marker_positions.round(7)} < here
