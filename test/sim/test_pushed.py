"""An object pushed over a floor by soft tips, against closed forms: friction, Mason, Lynch, rolling."""

from dataclasses import replace

import numpy as np
import pytest
from pushed_cell import BOX, DISC, SPEED, place, push, scene

from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_scene.scene_file import load_scene
from tactile_scene.shapes import make_surface
from tactile_sim._contact import PushedBody
from tactile_sim.cell import Cell
from tactile_sim.ideal_sensor import IdealSensor
from tactile_sim.limit_surface import Foot
from tactile_sim.pushed import PushedSettings, PushedState
from tactile_sim.pushing_scene import PushVariation, pushing_scene, read_profiles
from tactile_sim.tactip import TacTip

SHORT = ("blue_square", "blue_circle", "red_square", "yellow_hexagon")


@pytest.mark.parametrize("stiffness", [0.2, 1.0, 30.0])
def test_pushed_through_its_centre_it_goes_with_the_tip_which_presses_with_the_friction_of_the_floor(
    tmp_path, stiffness
):
    skin = {"skin_force": stiffness * 8.45, "skin_shear": stiffness * 1053.0}
    built = scene(tmp_path, friction=0.3, **skin)
    cell = Cell(built)
    push(cell, 2.0)
    before = place(cell)
    frame = push(cell, 1.0)[-1]
    moved = place(cell) - before
    np.testing.assert_allclose(moved, [0, SPEED, 0], atol=1e-6)
    settings = PushedSettings(**built.bodies["pushed"].motion_settings.values)
    assert settings.normal_force(frame.truth.depth) == pytest.approx(0.3 * 0.479 * 9.81, rel=0.01)
    assert cell.motion("pushed").state is PushedState.SLIDING


def test_it_stays_where_it_is_as_long_as_friction_carries_the_tip(tmp_path):
    cell, start = Cell(scene(tmp_path, friction=0.3)), None
    start = place(cell)
    push(cell, 0.15)
    assert cell.motion("pushed").state is PushedState.RESTING
    np.testing.assert_array_equal(place(cell), start)


def vote(direction, friction, contact, center):
    """Mason's theorem: the sense in which the object turns, by the sides on which the push and both edges of
    the friction cone pass its centre of friction; 0 where one of them passes it within 3 mm.
    """
    angles = np.arctan(friction) * np.array([-1.0, 0.0, 1.0])
    rays = np.stack([-np.sin(angles), np.cos(angles)], axis=1)  # about the normal, which is y
    rays[1] = direction / np.linalg.norm(direction)
    arms = center - contact
    passes = rays[:, 0] * arms[1] - rays[:, 1] * arms[0]  # > 0: on its right, which turns it to the left
    return 0.0 if np.abs(passes).min() < 3e-3 else np.sign(np.sign(passes).sum())


@pytest.mark.parametrize("seed", range(12))
def test_it_turns_as_push_and_friction_cone_vote(tmp_path, seed):
    rng = np.random.default_rng(seed)
    while True:
        tip, angle = rng.uniform(-0.03, 0.03), rng.uniform(-0.6, 0.6)
        off, friction = tuple(rng.uniform(-0.02, 0.02, 2).round(4).tolist()), rng.uniform(0.1, 0.9)
        direction = np.array([np.sin(angle), np.cos(angle)])
        expected = vote(direction, friction, np.array([tip, 0.0]), np.array([0.0, 0.04]) + off)
        if expected:
            break
    stiffness = 10.0 ** rng.uniform(0.0, 3.0)  # over that of the shipped skin
    skin = {"skin_force": 8.45 * stiffness, "skin_shear": 1053.0 * stiffness}
    cell = Cell(scene(tmp_path, (tip,), center_of_friction=off, friction_tip=friction, **skin))
    push(cell, 0.8, SPEED * direction)
    assert np.sign(place(cell)[2]) == expected
    assert abs(place(cell)[2]) > np.radians(0.2)


@pytest.mark.parametrize(
    "off, stable", [(0.0, True), (0.012, True), (-0.014, True), (0.026, False), (-0.03, False)]
)
def test_two_tips_side_by_side_push_it_without_turning_while_its_centre_of_friction_is_between_them(
    tmp_path, off, stable
):
    cell = Cell(scene(tmp_path, (-0.02, 0.02), center_of_friction=(off, 0.0)))
    push(cell, 1.5)
    before = place(cell)
    push(cell, 2.0)
    turned = np.degrees(abs(place(cell)[2] - before[2]))
    assert turned < 0.05 if stable else turned > 3.0


def test_a_slippery_tip_slides_along_and_presses_no_more_across_than_its_friction(tmp_path):
    """Pushed at 45 degrees, its centre of friction goes where the edge of the cone of friction points."""
    cell = Cell(scene(tmp_path, friction_tip=0.2, friction=0.3))
    push(cell, 1.0, (SPEED, SPEED))
    center, before = np.array([*cell.motion("pushed").pressure, 0.0, 1.0]), cell.T_world_body("pushed")
    push(cell, 0.1, (SPEED, SPEED))
    moved = before[:3, :3].T @ ((cell.T_world_body("pushed") - before) @ center)[:3]
    assert moved[0] / moved[1] == pytest.approx(0.2, rel=0.08)


def test_a_disc_rolls_along_the_tip(tmp_path):
    """The contact goes as far over the disc as over the tip, but for what the skin gives."""
    cell = Cell(scene(tmp_path, shape=DISC, height=0.03, friction_tip=2.0))
    push(cell, 1.0)

    def arcs(frame):
        T = np.linalg.inv(cell.T_world_body("pushed"))
        normal = -frame.truth.normal  # base and world are one; from the tip outward
        inside = T[:2, :2] @ -normal[:2]
        return np.array([0.04 * np.arctan2(inside[1], inside[0]), 0.02 * np.arctan2(normal[1], normal[0])])

    before = arcs(push(cell, 0.1)[-1])
    end = push(cell, 3.0, (0.6 * SPEED, 0.8 * SPEED))[-1]
    over_disc, over_tip = 1e3 * (arcs(end) - before)
    assert over_disc < -4.0
    assert over_disc + over_tip == pytest.approx(-1e3 * end.truth.shear[1], abs=0.1)


def rolled(sensor, angle, depth):
    """X_fs of a sensor that has rolled by an angle over a plane; 20 mm its radius."""
    plane, down = make_surface("plane"), se3.pose_from_euler([0, 0, 0, np.pi, 0, 0])
    way = [(0.0, -0.001), *((turn, depth) for turn in np.linspace(0.0, angle, 16))]
    for turn, deep in way:
        sensor.advance(plane, se3.pose_from_euler([0.02 * turn, 0, 0.02 - deep, 0, turn, 0]) @ down)
    return sensor.truth().T_fs


@pytest.mark.parametrize("depth", [0.002, 0.004])
def test_a_sensor_that_rolls_over_a_surface_shears_hardly_the_ideal_one_as_the_soft_skin(depth):
    angle = np.radians(15.0)
    soft, ideal = (1e3 * rolled(sensor, angle, depth)[0, 3] for sensor in (TacTip(), IdealSensor()))
    assert soft == pytest.approx(ideal, abs=0.05)
    assert abs(soft) < 0.1 * 20.0 * angle


def test_skin_and_curves_of_force_push_an_object_the_same_way():
    """The soft skin's measured force, and its curves where nothing measures it."""
    base = load_scene("pushing")
    ends = []
    for fidelity in ("image", "ideal"):
        cell = Cell(base if fidelity == "image" else base.with_fidelity("ideal"))
        push(cell, 1.0)
        push(cell, 1.5, (-0.6 * SPEED, SPEED))
        ends.append(place(cell))
    assert abs(ends[0][2]) > np.radians(4.0)
    np.testing.assert_allclose(1e3 * ends[0][:2], 1e3 * ends[1][:2], atol=0.3)
    assert np.degrees(ends[0][2] - ends[1][2]) == pytest.approx(0.0, abs=0.5)


def test_the_same_trial_is_the_same_bits_and_another_is_not(tmp_path):
    base, ends = load_scene("pushing").with_fidelity("ideal"), []
    for seed in (3, 3, 4):
        cell = Cell(pushing_scene(base, "red_square", "foam", seed))
        push(cell, 1.5)
        ends.append(cell.T_world_body("pushed").tobytes())
    assert ends[0] == ends[1] != ends[2]


@pytest.mark.parametrize("name", list(read_profiles().objects))
@pytest.mark.parametrize("scene_name", ["pushing", "dual_pushing"])
def test_every_object_stands_before_the_tips_in_every_trial(scene_name, name):
    base = load_scene(scene_name).with_fidelity("ideal")
    for seed in range(5):
        trial = pushing_scene(base, name, "mdf", seed, PushVariation(angle_deg=15.0, placement=0.01))
        Cell(trial)
        body = trial.bodies["pushed"]
        for arm, gap in zip(trial.arms.values(), (1e-3, 5e-3), strict=False):
            center = (se3.inverse(body.T_parent_body) @ arm.T_world_start)[:3, 3]
            assert body.make().distance(center[None])[0] - 0.02 == pytest.approx(gap, abs=1e-6)


@pytest.mark.parametrize(
    "scene_name, name",
    [("pushing", "blue_square"), ("dual_pushing", "blue_square"), ("dual_pushing_tall", "tall_blue_square")],
)
def test_the_scenes_name_the_numbers_of_the_profiles(scene_name, name):
    plain = load_scene(scene_name)
    made = pushing_scene(plain, name, "mdf")
    ours, theirs = (s.bodies["pushed"].motion_settings for s in (plain, made))
    assert ours.checked(PushedSettings, ours.values) == theirs.checked(PushedSettings, theirs.values)
    assert plain.bodies["pushed"].parameters == made.bodies["pushed"].parameters
    np.testing.assert_allclose(
        made.bodies["pushed"].T_parent_body, plain.bodies["pushed"].T_parent_body, atol=1e-8
    )
    for arm in plain.arms:
        np.testing.assert_allclose(made.arms[arm].T_world_start, plain.arms[arm].T_world_start, atol=1e-8)


def test_an_unknown_object_or_floor_is_named_with_those_that_there_are():
    base = load_scene("pushing")
    with pytest.raises(SettingError, match=r"object: unknown name 'blue_squar' .*blue_square"):
        pushing_scene(base, "blue_squar", "mdf")
    with pytest.raises(SettingError, match="floor: unknown name 'ice'"):
        pushing_scene(base, "blue_square", "ice")
    with pytest.raises(SettingError, match="none of its bodies has the motion 'pushed'"):
        pushing_scene(load_scene("ramp"), "blue_square", "mdf")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"at": (0.0, 0.035)}, "overlaps the tip of arm 'tip0' by 4.0 mm at the start: move"),
        ({"center_of_gravity": (0.05, 0.0, 0.0)}, "center_of_gravity is 10.0 mm outside what the body"),
        ({"shape": "shape: sphere\n    parameters: {radius: 0.03}"}, "stands on no area .*flat base"),
        ({"shape": BOX.replace("0.06]", "0.05]")}, "lowest point is at z = 0.0050 m.* z to 0.0250"),
    ],
)  # fmt: skip
def test_a_scene_that_cannot_be_is_refused_with_what_to_change(tmp_path, changes, message):
    with pytest.raises(SettingError, match=message):
        Cell(scene(tmp_path, **changes))


def test_an_object_inside_another_is_refused(tmp_path):
    built = scene(tmp_path)
    other = replace(built.bodies["pushed"], name="other")
    with pytest.raises(SettingError, match=r"body 'pushed' overlaps body 'other' by .* move one of them"):
        Cell(replace(built, bodies={**built.bodies, "other": other}))


def test_a_step_that_finds_no_balance_says_so():
    foot, level = Foot.around([[-0.04, -0.04], [0.04, -0.04], [0.04, 0.04], [-0.04, 0.04]]), np.eye(4)
    body = PushedBody(foot.numbers, foot.arm, level, [0.0, 0.0, 0.0], 4.7, 0.3, [0.0, 0.0], 0.0, 0.03, 0.9)
    tip = body.tip(level, level, [0.0, -0.04, 0.0], [0.0, -1.0, 0.0], [0.0, 2.0, 0.0], 0.0, 0.0)  # no spring
    with pytest.raises(ValueError, match=r"no motion found .* balances its 1 tips; take shorter steps"):
        body.step(level, tip)
