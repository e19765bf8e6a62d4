"""`tactile cell`: what it finds goes into the scene, and the scene then agrees; each refusal a sentence."""

import json

import numpy as np
import pytest

from tactile_base.config_paths import config_path
from tactile_bringup import cell_touching
from tactile_bringup.cli import main
from tactile_bringup.experiments.pushing import PLANE, Common, Trial
from tactile_bringup.experiments.pushing_plane import Batch, plane_rows
from tactile_geometry import se3
from tactile_records.calibrating.results import pose_values
from tactile_scene.scene_file import load_scene

OFF = ", in_tool: {position: [0.0014, -0.0014, 0.065], rotation_deg: [0, 0, 5]}"


def table(folder, truth, rate=30):
    """The table's scene with an ideal sensor, of which its simulation says more than the scene."""
    text = config_path("scenes/plane.yaml").read_text().replace("camera_rate: 60", f"camera_rate: {rate}")
    text += f"simulation:\n  rate: {2 * rate}\n  sensors:\n    arm: {{fidelity: ideal{truth}}}\n"
    (folder / "my_cell.yaml").write_text(text)
    return folder / "my_cell.yaml"


@pytest.fixture(scope="module")
def touched(tmp_path_factory):
    """A run that touches with a sensor that is 2 mm beside and 5 degrees turned from what the scene says."""
    folder = tmp_path_factory.mktemp("touched")
    cell_touching.simulated(load_scene(table(folder, OFF)), "arm", "mounting", rest=0.1).save(
        folder / "run.npz"
    )
    return folder / "run.npz"


def cell(what, scene, tmp_path, *words):
    return main(["cell", what, "--scene", str(scene), "--out", str(tmp_path / "out"), *words])


def test_a_camera_25_ms_late_is_found_written_into_the_scene_and_then_agreed_with(tmp_path, capsys):
    path, run = table(tmp_path, ", delay: 0.025", 60), tmp_path / "run.npz"
    cell_touching.simulated(load_scene(path), "arm", "time", periods=10).save(run)
    assert cell("time", path, tmp_path, "--from", str(run)) == 3
    assert "the scene does not agree; --write sets time_offset: -0.02" in capsys.readouterr().out
    assert cell("time", path, tmp_path, "--from", str(run), "--write") == 0
    assert load_scene(path).arms["arm"].sensor.settings.time_offset == pytest.approx(-0.025, abs=0.004)
    assert "# pointing down, the tip 12 mm above the table" in path.read_text()
    assert cell("time", path, tmp_path, "--simulate", "--set", "periods=10", "--seed", "1") == 0
    assert not json.loads((tmp_path / "out" / "time-1.json").read_text())["agrees"], "of the first one"
    assert (tmp_path / "out" / "time-2.png").exists()
    numbers = json.loads((tmp_path / "out" / "time.json").read_text())
    assert numbers["agrees"] and numbers["time_offset_ms"] == pytest.approx(-25.0, abs=4.0)
    assert numbers["sigma_ms"] < 2.5
    assert (tmp_path / "out" / "time.png").stat().st_size > 20_000


def test_a_tip_2_mm_beside_the_scenes_is_found_and_written_where_it_was(touched, tmp_path, capsys):
    path = table(tmp_path, OFF)
    assert cell("tip", path, tmp_path, "--from", str(touched), "--write") == 0
    assert "across the axis 1." in capsys.readouterr().out
    where = load_scene(path).arms["arm"].sensor.T_tool_sensor
    assert where[:2, 3] == pytest.approx([0.0014, -0.0014], abs=1.5e-4)
    assert where[2, 3] == pytest.approx(0.065, abs=1e-3)
    numbers = json.loads((tmp_path / "out" / "tip.json").read_text())
    assert numbers["touches"] == 11 and numbers["residual_mm"] < 0.04 and not numbers["agrees"]


def test_a_sensor_turned_by_5_degrees_is_found_and_written_where_its_tip_stays(touched, tmp_path):
    path = table(tmp_path, OFF)
    assert cell("mounting", path, tmp_path, "--from", str(touched)) == 3
    assert cell("mounting", path, tmp_path, "--from", str(touched), "--write") == 0
    where = load_scene(path).arms["arm"].sensor.T_tool_sensor
    assert where[:3, 3].tolist() == [0.0, 0.0, 0.065]
    numbers = json.loads((tmp_path / "out" / "mounting.json").read_text())
    found, sigma = numbers["rotation_deg"], numbers["sigma_deg"]
    assert all(abs(x - said) < 3.0 * s for x, said, s in zip(found, (0.0, 0.0, 5.0), sigma, strict=True))
    assert numbers["contacts"] == 11 and not numbers["agrees"] and max(sigma) < 0.8
    assert se3.euler_from_pose(where)[5] == pytest.approx(np.radians(found[2]), abs=0.002)


def pushed(angle, offset):
    """Sizes of the final errors (mm) of our steering with a sensor that is turned and shifted by so much."""
    mounted = ("contact_angle", angle), ("contact_offset", offset)
    common = Common("single", "tuned", PLANE)
    trials = tuple(Trial(common, "blue_square", "mdf", number, mounted) for number in range(10))
    return np.array([row["error_abs_mm"] for row in plane_rows(Batch(trials))])


def test_what_both_leave_of_3_degrees_and_1_mm_steers_a_push_to_half_a_millimetre(tmp_path):
    said = load_scene("plane").arms["arm"].sensor.T_tool_sensor
    T = said @ se3.pose_from_euler([0.0, 1e-3, 0.0, -np.radians(3.0), 0.0, 0.0])  # x points down in a push
    path, run = table(tmp_path, f", in_tool: {pose_values(T)}"), tmp_path / "run.npz"
    cell_touching.simulated(load_scene(path), "arm", "mounting", rest=0.1).save(run)
    for what in ("tip", "mounting"):
        assert cell(what, path, tmp_path, "--from", str(run), "--write") == 0
    now = load_scene(path).arms["arm"].sensor.T_tool_sensor
    left = se3.euler_from_pose(se3.inverse(now) @ T)
    assert pushed(-np.degrees(left[3]), 1e3 * left[1]).max() < 0.5
    assert pushed(3.0, 1.0).min() > 1.0, "without them"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--scene", "plane", "--simulate", "--write"], "--write needs a scene file of your own"),
        (["--scene", "ur_example", "--simulate"], "arm 'arm' has the driver 'ur', not 'sim'"),
        (["--scene", "ur_example", "--rehearse", "--write"], "is true of its doubles, not of the cell"),
        (["--scene", "plane", "--simulate", "--rehearse"], "at most one of them says where a run comes from"),
        (
            ["--scene", "two_arms", "--simulate"],
            "--arm must name an arm with a sensor; there are: left, right",
        ),
        (["--scene", "plane", "--simulate", "--set", "period=[1"], "--set period=[1"),
        (["--scene", "plane", "--from", "nowhere.npz"], "nowhere.npz: No such file or directory"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(words, why, tmp_path, capsys):
    assert main(["cell", "time", *words, "--out", str(tmp_path)]) == 1
    assert why in " ".join(capsys.readouterr().err.split())
