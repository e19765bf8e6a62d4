"""Real pushes: the format as it is described, pushes of another integrator, and what is refused."""

import json
import math

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from tactile_bringup.cli import main
from tactile_bringup.experiments.real_pushes import read_pushes, shares_of, slide_of, support_of

NAME, SUPPORT = "10_130_10_10_10_130", np.array([[10.0, 10.0], [130.0, 10.0], [10.0, 130.0]])  # mm
CENTER = np.array([50.0, 50.0])  # mm, of a triangle with legs of 150 mm
FRICTION = 4.2  # N in all
# of the force sensor against the finger: turned by 45 deg, and mirrored; what it feels is the reaction
SENSOR = -np.array([[1.0, 1.0], [1.0, -1.0]]) / math.sqrt(2.0)
EDGES = {"left": ([0.0, None], [1.0, 0.0]), "bottom": ([None, 0.0], [0.0, 1.0])}


def turned(angle):
    return Rotation.from_euler("z", angle).as_matrix()[:2, :2]


def speeds(motion):
    """Of the points of support, in the block's frame, for a motion of its centre."""
    arms = SUPPORT - CENTER
    return motion[:2] + motion[2] * np.stack([-arms[:, 1], arms[:, 0]], axis=1)


def load(motion):
    """What Coulomb's law has the floor take."""
    each = speeds(motion)
    forces = FRICTION / 3.0 * each / np.linalg.norm(each, axis=1)[:, None]
    arms = SUPPORT - CENTER
    return np.array([*forces.sum(axis=0), (arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0]).sum()])


def pushed(seed, way=10.0, steps=200):
    """A finger that sticks to the block where it touches: of all turns the floor takes the least power.

    Returns poses of the block before and after, the finger's path, and the forces on the block (world).
    """
    random = np.random.default_rng(seed)
    where, normal = EDGES["left" if seed % 2 else "bottom"]
    contact = np.array([random.uniform(20.0, 110.0) if part is None else part for part in where])
    heading = turned(random.uniform(-0.25, 0.25)) @ normal
    pose = np.array([600.0, 20.0, random.uniform(-1.0, 1.0)])
    before, path, forces = pose.copy(), [], []
    aim = turned(pose[2]) @ heading * way / steps
    arm = contact - CENTER
    finger = pose[:2] + turned(pose[2]) @ contact
    for _ in range(steps):
        path.append([*finger, math.atan2(aim[1], aim[0])])
        wanted = turned(pose[2]).T @ aim

        def motion(turn, wanted=wanted):
            return np.array([*(wanted - turn * np.array([-arm[1], arm[0]])), turn])

        bounds = (-0.05 * way / steps, 0.05 * way / steps)
        turn = minimize_scalar(
            lambda turn: np.linalg.norm(speeds(motion(turn)), axis=1).sum(), bounds=bounds, method="bounded",
            options={"xatol": 1e-10},
        ).x  # fmt: skip
        moved = motion(turn)
        forces.append(turned(pose[2]) @ load(moved)[:2])
        middle = pose[:2] + turned(pose[2]) @ CENTER + turned(pose[2] + 0.5 * turn) @ moved[:2]
        pose = np.array([*(middle - turned(pose[2] + turn) @ CENTER), pose[2] + turn])
        finger = finger + aim
    return before, pose, np.array(path), np.array(forces)


def numbers(pose):
    x, y, z, w = Rotation.from_euler("z", pose[2]).as_quat()
    return [*pose[:2], 8.5, w, x, y, z]


def text(pushes, offset=(0.02, -0.08)):
    """A file as the data's description has it."""
    parts = [[len(pushes)]]
    for before, after, path, forces in pushes:
        run_up = 30
        lead = path[0, :2] - 0.05 * np.arange(run_up, 0, -1)[:, None] * [
            math.cos(path[0, 2]), math.sin(path[0, 2])
        ]  # fmt: skip
        finger = np.vstack([np.column_stack([lead, np.full(run_up, path[0, 2])]), path])
        felt = [SENSOR @ (turned(row[2]).T @ force) for row, force in zip(path, forces, strict=True)]
        felt = np.vstack([np.zeros((run_up, 2)), felt]) + offset
        times = 1.4e9 + 0.01 * np.arange(len(finger))
        parts += [numbers(before), numbers(after), [len(felt)]]
        parts += [[time, *row] for time, row in zip(times, felt, strict=True)]
        parts += [[len(finger)]]
        parts += [[time, *numbers(row)] for time, row in zip(times, finger, strict=True)]
    return "\n".join(
        " ".join(f"{number:.9g}" if abs(number) < 1e6 else f"{number:.6f}" for number in part)
        for part in parts
    )


@pytest.fixture(scope="module")
def pushes():
    return [pushed(seed) for seed in range(12)]


@pytest.fixture
def folder(tmp_path, pushes):
    (tmp_path / "pushes").mkdir()
    (tmp_path / "pushes" / f"{NAME}.txt").write_text(text(pushes))
    return tmp_path / "pushes"


def test_a_file_says_what_was_pushed(folder, pushes):
    found = read_pushes(folder / f"{NAME}.txt")
    assert len(found) == len(pushes)
    for push, (before, after, path, forces) in zip(found, pushes, strict=True):
        for pose, true in ((push.before, before), (push.after, after)):
            np.testing.assert_allclose(pose, [*(1e-3 * true[:2]), true[2]], atol=1e-7)
        np.testing.assert_allclose(push.finger[-len(path) :, 1:3], 1e-3 * path[:, :2], atol=1e-7)
        np.testing.assert_allclose(push.force[-len(forces) :, 1:], forces, atol=1e-6)


def test_the_load_of_a_push_is_on_coulombs_limit(folder, pushes):
    for push in read_pushes(folder / f"{NAME}.txt"):
        slide = slide_of(push)
        assert 0.3 * FRICTION < np.linalg.norm(slide.load[:2]) <= FRICTION + 1e-3
        assert slide.load @ slide.motion > 0.0


def test_the_exact_model_finds_motion_friction_and_end_of_another_integrators_pushes(
    folder, tmp_path, capsys
):
    assert main(["experiment", "real-pushes", str(folder), "--out", str(tmp_path / "out")]) == 0
    assert "polynomial" in capsys.readouterr().out
    results = {row["model"]: row for row in json.loads((tmp_path / "out/real_pushes.json").read_text())}
    exact = results["points"]
    assert exact["pushes"] == 12 and exact["motion"]["median"] < 1.0
    assert exact["friction"]["median"] == pytest.approx(FRICTION, rel=0.01)
    assert exact["end_mm"]["median"] < 0.1 and exact["end_deg"]["median"] < 0.1
    for other in ("ellipsoid", "polynomial"):
        assert results[other]["motion"]["median"] > exact["motion"]["median"]
        assert (
            results[other]["motion"]["low"]
            <= results[other]["motion"]["median"]
            <= results[other]["motion"]["high"]
        )
    assert (tmp_path / "out/real_pushes.md").read_text().count("\n") == 5


def test_the_weight_lies_on_the_points_as_statics_says(tmp_path):
    np.testing.assert_allclose(shares_of(support_of(tmp_path / f"{NAME}.txt")), 1.0 / 3.0)
    foot = support_of(tmp_path / "patch.txt")
    assert shares_of(foot).sum() == pytest.approx(1.0)
    assert shares_of(foot) @ foot == pytest.approx([0.05, 0.05])
    points = 1e-3 * np.array([[20.0, 20.0], [100.0, 20.0], [30.0, 110.0]])
    assert shares_of(points) @ points == pytest.approx([0.05, 0.05])


@pytest.mark.parametrize(
    "name, change, message",
    [
        ("wood", lambda whole: whole, "is named after no support: must be patch, or x1_x2_x3"),
        ("10_20_30_10_20_15", lambda whole: whole, "it would fall over"),
        (NAME, lambda whole: whole[: len(whole) // 2], "the file ends"),
        (NAME, lambda whole: whole + " 7", "1 numbers follow after 12 pushes"),
        (NAME, lambda whole: whole.replace("0.02", "nought", 1), "must hold numbers alone"),
        (NAME, lambda whole: whole.replace("8.5", "nan", 1), "a number that is not finite"),
        (NAME, lambda whole: "", "holds nothing"),
        (NAME, lambda whole: whole.replace(" 8.5 ", " 8.5 7", 1), "is no quaternion"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(tmp_path, pushes, name, change, message, capsys):
    (tmp_path / f"{name}.txt").write_text(change(text(pushes)))
    assert main(["experiment", "real-pushes", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_folder_without_pushes_is_refused(tmp_path, capsys):
    assert main(["experiment", "real-pushes", str(tmp_path)]) == 2
    assert "holds no pushes" in capsys.readouterr().err
