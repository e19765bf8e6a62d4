"""Experiments in pushing: a trial is what its name says, tables say what trials did, bad input is told."""

import json

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_bringup.cli import main
from tactile_bringup.experiments.pushing import Common, Trial, check_trial, load_maps, load_tables, setup_of
from tactile_bringup.experiments.pushing_results import (
    COLUMNS,
    Outcome,
    failures,
    markdown,
    table_rows,
    write_map,
)
from tactile_bringup.experiments.pushing_variations import VARIABLES, drawn
from tactile_geometry import se3
from tactile_sim.pushed import PushedSettings
from tactile_sim.pushing_scene import draw


def made_up(name="blue_square", floor="mdf", number=0, error=1.0, **changes):
    row = {
        "name": f"{name}/{floor}/{number}",
        "object": name,
        "floor": floor,
        "trial": number,
        "varied": {},
        "succeeded": True,
        "reason": "",
        "error_mm": error,
        "work_s": 40.0,
        "contact_lost": False,
        "toppled": False,
    }
    return row | changes


# ---- the tables ----


def test_the_tables_are_the_papers():
    tables = load_tables()
    rows = {name: len(table.paper) for name, table in tables.items()}
    assert rows == {"single": 8, "dual": 8, "tall": 9}
    assert tables["single"].paper["blue_circle", "mdf"] == (9.45, 0.13)
    assert tables["dual"].paper["blue_circle", "foam"] == (4.46, 3.35)
    assert tables["tall"].paper["coffee_tin", "mdf"] == (4.81, 2.09)


@pytest.mark.parametrize("name", list(load_tables()))
def test_every_row_of_the_tables_can_be_tried(name):
    for row in load_tables()[name].rows():
        check_trial(Trial(Common(name), *row, 0))


def test_the_corners_of_every_map_can_be_tried():
    for chosen in load_maps().values():
        places = chosen.places()
        for place in (places[0], places[-1]):
            common = Common(chosen.table, fidelity=chosen.fidelity)
            check_trial(Trial(common, chosen.object, chosen.floor, 0, place))


def test_a_table_says_mean_and_deviation_beside_the_papers():
    rows = [made_up(error=error, number=n) for n, error in enumerate([1.0, 3.0, -1.0])]
    rows.append(made_up(number=3, error=80.0, succeeded=False, reason="contact was lost", contact_lost=True))
    (line,) = table_rows(load_tables()["single"], rows)
    values = dict(zip(COLUMNS, line, strict=True))
    assert (values["trials"], values["at the target"], values["contact lost"]) == (4, 3, 1)
    assert values["mean [mm]"] == pytest.approx(1.0) and values["deviation [mm]"] == pytest.approx(2.0)
    assert values["mean size [mm]"] == pytest.approx(5.0 / 3.0) and values["largest [mm]"] == 3.0
    assert values["paper's mean [mm]"] == 4.45
    assert "| blue square | mdf | 4 | 3 | 1.00 |" in markdown(COLUMNS, [line])
    assert failures(rows) == ["blue_square/mdf/3: contact was lost"]


def test_the_deviation_is_among_trials_of_one_floor():
    errors = [1.0, 3.0, 1.0, 3.0, 2.0, 11.0, 13.0, 11.0, 13.0, 12.0]
    values = Outcome.of([made_up(number=n, error=error) for n, error in enumerate(errors)]).numbers()
    assert values == pytest.approx([7.0, 1.0, 7.0, 13.0])
    assert np.isnan(Outcome.of([made_up(number=n) for n in (0, 5, 10)]).deviation)


def test_trials_that_never_arrive_have_no_error():
    outcome = Outcome.of([made_up(succeeded=False, error=None)])
    assert outcome.success == 0.0 and np.isnan(outcome.numbers()).all()


@pytest.mark.parametrize("name", ["floor", "circle_start"])
def test_a_map_names_a_trial_where_it_breaks(tmp_path, name):
    chosen = load_maps()[name]
    trials = [
        Trial(Common(chosen.table), chosen.object, chosen.floor, n, place)
        for place in chosen.places()
        for n in (0, 1)
    ]
    rows = [made_up() | {"name": trial.name} for trial in trials]
    rows[0] |= {"succeeded": False, "reason": "the target was passed"}
    page, picture, table = write_map(tmp_path, chosen, rows, trials)
    assert "data:image/png" in page.read_text() and chosen.name.replace("_", " ") in page.read_text()
    assert picture.stat().st_size > 20_000
    first, second = table.read_text().splitlines()[2:4]
    assert f"{trials[0].name}: the target was passed" in first and "| 2 | 1 |" in first
    assert "| 2 | 2 |" in second and "passed" not in second


# ---- trials ----


def setting_of(trial, name):
    scene = setup_of(trial).pushing_scene()
    (body,) = scene.bodies.values()
    return getattr(body.motion_settings.checked(PushedSettings, body.motion_settings.values), name)


def trial(*varied, number=3):
    return Trial(Common("dual"), "blue_square", "foam", number, varied)


def test_the_number_of_a_trial_draws_the_place_and_that_of_its_five_the_floor():
    one, same, beside, later = (drawn(setup_of(trial(number=n)).pushing_scene()) for n in (1, 1, 4, 6))
    placed = {"offset_mm", "angle_deg"}
    assert one == same
    assert {key for key in one if one[key] != beside[key]} == placed
    assert {key for key in one if one[key] != later[key]} == set(one) - {"mass_kg"}


def test_objects_and_floors_draw_each_their_own():
    draws = [draw(name, floor, 0) for name in ("red_square", "blue_circle") for floor in ("foam", "mdf")]
    assert len({value for each in draws for value in each}) == 24
    assert not draw("red_square", "foam", None).any()


@pytest.mark.parametrize("name", ["friction", "mass"])
def test_factors_multiply_what_the_profile_says(name):
    assert setting_of(trial((name, 2.0)), name) == pytest.approx(2.0 * setting_of(trial(), name))


def test_offset_and_angle_are_added_to_the_draw():
    before, after = (
        drawn(setup_of(each).pushing_scene()) for each in (trial(), trial(("offset", 7.0), ("angle", 10.0)))
    )
    assert after["offset_mm"] - before["offset_mm"] == pytest.approx(7.0)
    assert after["angle_deg"] - before["angle_deg"] == pytest.approx(10.0)


def test_size_stretches_the_object_along_the_floor_and_keeps_its_height():
    sizes = [
        setup_of(each).pushing_scene().bodies["pushed"].parameters.size
        for each in (trial(), trial(("size", 1.5)))
    ]
    assert sizes[1] == pytest.approx((1.5 * sizes[0][0], 1.5 * sizes[0][1], sizes[0][2]))


def test_noise_rate_latency_and_filter_reach_sensor_and_loop():
    plain = setup_of(trial())
    changed = setup_of(trial(("noise", 2.0), ("rate", 20.0), ("latency", 50.0), ("filter", "paper")))
    sigma = [setup.scene.simulation.sensors["leader"].model.sigma_position for setup in (plain, changed)]
    assert sigma[1] == pytest.approx(2.0 * np.array(sigma[0]))
    assert changed.scene.arms["follower"].sensor.settings.camera_rate == 20.0
    assert changed.options.latency == pytest.approx(0.05)
    assert changed.options.filter != plain.options.filter


def test_the_draw_of_the_centre_of_friction_can_be_widened():
    assert setting_of(trial(("center_of_friction", 0.0)), "center_of_friction") == (0.0, 0.0)


@pytest.mark.parametrize(
    "varied, message",
    [
        (("colour", 1.0), "unknown name 'colour'"),
        (("rate", 50.0), r"rate = 50 Hz: the simulation's rate, 120 Hz, must be a multiple"),
        (("latency", -1.0), r"latency = -1 ms: must lie in \[0, 1000\] ms"),
        (("filter", 1.0), "filter = 1.0: must be a name"),
        (("mass", "heavy"), "mass = 'heavy': must be a number"),
        (("friction", -1.0), "friction"),
        (("noise", 0.0), "noise = 0: must be above 0"),
    ],
)
def test_a_wrong_variable_is_told(varied, message):
    with pytest.raises((SettingError, FileNotFoundError), match=message):
        check_trial(trial(varied))


def test_noise_of_images_cannot_be_set():
    images = Trial(Common("single", fidelity="image"), "blue_square", "mdf", 0, (("noise", 2.0),))
    with pytest.raises(SettingError, match="fidelity 'ideal' alone"):
        check_trial(images)
    assert set(VARIABLES) >= {name for chosen in load_maps().values() for name in chosen.variables}


def test_what_differs_between_floors_and_pushes_reaches_the_object():
    fields = [("friction_field", 0.2), ("friction_field_length", 30.0), ("friction_speed", 0.1)]
    assert [setting_of(trial(*fields), name) for name, _ in fields] == [0.2, 0.03, 0.1]
    seeds = [setting_of(trial(*fields, number=n), "friction_field_seed") for n in (3, 4, 6)]
    assert seeds[0] == seeds[1] != seeds[2]
    one, other = (setting_of(trial(("push_friction", 0.2), number=n), "friction") for n in (3, 4))
    assert one != other and setting_of(trial(number=3), "friction") == setting_of(trial(number=4), "friction")


def test_a_contact_angle_turns_the_pushing_sensor_to_the_left_unknown_to_its_arm():
    plain, turned = (setup_of(trial(*v)).scene for v in ((), (("contact_angle", 3.0),)))
    assert turned.arms["leader"].T_tool_controlled == pytest.approx(plain.arms["leader"].T_tool_controlled)
    T_tool_sensor = se3.pose_from_euler(turned.simulation.sensors["leader"].in_tool)
    T_base_tool = turned.arms["leader"].T_world_start @ se3.inverse(turned.arms["leader"].T_tool_controlled)
    ahead, said = (T_base_tool @ T_tool_sensor)[:2, 2], turned.arms["leader"].T_world_start[:2, 2]
    assert np.degrees(np.arctan2(*(ahead @ [[-said[1], said[0]], [said[0], said[1]]]))) == pytest.approx(3.0)
    assert not turned.simulation.sensors["follower"].in_tool


def test_pins_wear_off_images_alone():
    worn = Trial(Common("single", fidelity="input"), "blue_square", "mdf", 0, (("pin_wear", 0.2),))
    assert setup_of(worn).scene.simulation.sensors["arm"].model.markers.worn == 0.2
    with pytest.raises(SettingError, match="only images have pins; choose --fidelity input or image"):
        check_trial(trial(("pin_wear", 0.2)))


# ---- the command ----


def command(folder, *words):
    return main(["experiment", "pushing", "--out", str(folder), "--jobs", "1", *map(str, words)])


@pytest.fixture(scope="module")
def tried(tmp_path_factory):
    """One trial of one row."""
    folder = tmp_path_factory.mktemp("experiment")
    row = ["--table", "single", "--objects", "red_square", "--floors", "foam"]
    assert command(folder, *row, "--trials", 1) == 0
    return folder, row


def test_each_trial_is_a_line_with_what_was_drawn_and_what_came_of_it(tried):
    folder, _ = tried
    (row,) = [json.loads(line) for line in (folder / "trials.jsonl").read_text().splitlines()]
    drawn = {"friction", "mass_kg", "offset_mm", "angle_deg", "center_of_friction_x_mm"}
    assert drawn | {"wall_s", "work_s", "error_believed_mm", "contact_lost", "reason"} <= row.keys()
    assert (row["name"], row["trial"]) == ("red_square/foam/0", 0)
    assert row["succeeded"] and abs(row["error_mm"]) < 30.0 and not row["toppled"]
    assert "| red square | foam | 1 | 1 |" in (folder / "table.md").read_text()
    assert len((folder / "trials.csv").read_text().splitlines()) == 2


def test_the_same_command_goes_on_and_does_nothing_twice(tried, capsys):
    folder, row = tried
    before = (folder / "trials.jsonl").read_text()
    assert command(folder, *row, "--trials", 1) == 0
    assert "1 of 1 trials are done already" in capsys.readouterr().err
    assert (folder / "trials.jsonl").read_text() == before


def test_a_trial_run_alone_gives_its_numbers_again_with_pictures(tried):
    folder, row = tried
    assert command(folder, *row, "--trial", "red_square/foam/0") == 0
    place = folder / "red_square-foam-0"
    again = json.loads((place / "report.json").read_text())
    kept = json.loads((folder / "trials.jsonl").read_text())
    assert again["push"]["error_mm"] == kept["error_mm"]
    assert (place / "push.png").stat().st_size > 20_000 and (place / "run.npz").exists()


def test_trials_of_other_settings_do_not_mix_into_a_folder(tried, capsys):
    folder, row = tried
    assert command(folder, *row, "--latency", 20) == 2
    assert "was made with another latency" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words, message",
    [
        (["--table", "triple"], "table: unknown name 'triple'"),
        (["--table", "single", "--objects", "teapot"], "object unknown name 'teapot'"),
        (["--table", "tall", "--floors", "foam"], "floor unknown name 'foam'"),
        (["--table", "single", "--controller", "best"], "controller: unknown name 'best'"),
        (["--table", "single", "--fidelity", "perfect"], "fidelity: unknown name 'perfect'"),
        (["--table", "single", "--arm", "third"], "--arm third"),
        (["--table", "single", "--set", "pusher.task.speed=fast"], "speed"),
        (["--table", "single", "--filter", "best"], "best"),
        (["--table", "single", "--latency", "-1"], "latency = -1 ms: must lie in [0, 1000] ms"),
        (["--table", "dual", "--trial", "red_square/foam/x"], "or a trial's name, as blue_square/foam/3"),
        (["--table", "dual", "--trial", "-1"], "must be a number from 0 on"),
        (["--map", "start", "--trial", "blue_square/mdf/0"], "as blue_square/mdf/offset=-15/angle=-20/3"),
        (["--map", "moon"], "map: unknown name 'moon'"),
        (["--map", "floor", "--objects", "red_square"], "a map says which row it varies"),
    ],
)
def test_wrong_input_is_told_before_anything_runs(tmp_path, capsys, words, message):
    assert command(tmp_path / "out", *words) == 2
    said = capsys.readouterr().err
    assert message in " ".join(said.split()) and "Traceback" not in said
    assert not (tmp_path / "out" / "trials.jsonl").exists()
