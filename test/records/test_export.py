"""A run for other tools: units in the names, numbers that SciPy and a plain reader get back, TUM for evo."""

import csv
import importlib.util

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_bringup.cli import main
from tactile_geometry import se3
from tactile_records.runs import export
from tactile_records.runs.record import BeliefSeries, CommandSeries, PoseSeries, RunRecord, StageSeries

STAMPS = 1_700_000_000_000_000_000 + 10_000_000 * np.arange(4)
POSES = np.array([se3.exp([0.1 * k, 0.2, -0.1, 0.3, 0.1 * k, 0.2]) for k in range(4)])
BELIEFS = np.array([se3.exp([0.0, 1e-3, -3e-3, 0.1, 0.02 * k, 0.0]) for k in range(4)])
COV = np.array([np.diag([1e-8, 2e-8, 3e-8, 1e-4, 2e-4, 3e-4])] * 4)


@pytest.fixture
def record() -> RunRecord:
    record = RunRecord(arm="left")
    record.pose = PoseSeries(STAMPS, POSES)
    record.belief = BeliefSeries(STAMPS, BELIEFS, COV, nis=np.full(4, np.nan))
    record.command = CommandSeries(STAMPS, twist=np.full((4, 6), 0.01), phase=np.array(["follow"] * 4))
    record.latency = {"filter": StageSeries(STAMPS, np.full(4, 0.004))}
    return record


def rows(path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_stream_with_rows_is_a_table_whose_columns_say_their_unit(record):
    tables = export.tables(record)
    assert set(tables) == {"pose", "belief", "command", "latency"}
    plain = {"phase", "goal", "stage", "nis", "nis_dof", "accepted"}
    units = ("_s", "_m", "_rad", "_m2", "_rad2", "_m_rad", "_m_s", "_rad_s", "_qx", "_qy", "_qz", "_qw")
    for table in tables.values():
        assert all(name in plain or name.endswith(units) for name in table), list(table)
        assert len({len(column) for column in table.values()}) == 1


def test_poses_and_covariances_come_back(record, tmp_path):
    record.save(tmp_path / "run.npz")
    assert main(["export", str(tmp_path / "run.npz"), "--out", str(tmp_path / "out")]) == 0
    for row, T in zip(rows(tmp_path / "out/left/pose.csv"), POSES, strict=True):
        q = [float(row[f"T_base_sensor_q{axis}"]) for axis in "xyzw"]
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), T[:3, :3], atol=1e-12)
        np.testing.assert_allclose([float(row[f"T_base_sensor_{axis}_m"]) for axis in "xyz"], T[:3, 3])
    belief = rows(tmp_path / "out/left/belief.csv")
    assert (
        float(belief[0]["cov_phi_y_phi_y_rad2"]) == 2e-4 and float(belief[0]["cov_rho_z_phi_x_m_rad"]) == 0.0
    )
    assert belief[0]["nis"] == "", "what is not known is empty"
    angles = Rotation.from_matrix(BELIEFS[3][:3, :3].T).as_euler("xyz")
    found = [float(belief[3][f"contact_{name}_rad"]) for name in ("alpha", "beta", "gamma")]
    np.testing.assert_allclose(found, angles, atol=1e-12)


def test_trajectories_are_as_evo_reads_them(record, tmp_path):
    record.save(tmp_path / "run.npz")
    assert main(["export", str(tmp_path / "run.npz"), "--as", "tum", "--out", str(tmp_path / "out")]) == 0
    numbers = np.loadtxt(tmp_path / "out/left/contact.tum")
    assert numbers.shape == (4, 8)
    for row, T in zip(numbers, POSES @ BELIEFS, strict=True):
        np.testing.assert_allclose(row[1:4], T[:3, 3], atol=1e-8)
        np.testing.assert_allclose(Rotation.from_quat(row[4:]).as_matrix(), T[:3, :3], atol=1e-7)
    first = (tmp_path / "out/left/sensor.tum").read_text().splitlines()[2].split()
    assert first[0] == "1700000000.010000000"


def test_a_format_that_needs_more_says_what(record, tmp_path, capsys, monkeypatch):
    record.save(tmp_path / "run.npz")
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pyarrow" else find(name))
    assert main(["export", str(tmp_path / "run.npz"), "--as", "parquet"]) == 2
    assert "pip install pyarrow" in capsys.readouterr().err
