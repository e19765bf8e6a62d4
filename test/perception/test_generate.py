"""`tactile data generate`: deterministic, resumable, readable."""

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from clusters import local_cluster

from tactile_bringup.commands import data as data_command
from tactile_perception.datasets.dataset import read_dataset
from tactile_perception.datasets.layout import REFERENCE_NAME


def generate(out: Path, *options: str) -> int:
    parser = argparse.ArgumentParser(prog="tactile")
    data_command.register(parser.add_subparsers())
    parsed = parser.parse_args(["data", "generate", str(out), "--jobs", "1", *options])
    return parsed.run(parsed)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("generated")
    assert generate(out, "--train", "6", "--val", "3", "--seed", "5") == 0
    return out


def test_what_is_generated_reads_without_complaint(data):
    for name, count in (("train", 6), ("val", 3)):
        samples = read_dataset(data / name)
        assert len(samples) == count
        assert samples.report.problems == {} and samples.report.notes == []


def test_labels_lie_in_the_ranges_of_the_paper(data):
    x, y, z, alpha, beta, gamma = read_dataset(data / "train").euler_mm_deg.T
    assert np.hypot(x, y).max() <= 5.0 and np.abs(gamma).max() <= 5.0
    assert z.min() >= 0.5 and z.max() <= 6.0
    assert np.degrees(np.arccos(np.cos(np.radians(alpha)) * np.cos(np.radians(beta)))).max() <= 25.01


def test_training_and_validation_samples_differ(data):
    train, val = read_dataset(data / "train"), read_dataset(data / "val")
    assert not set(train.euler_mm_deg[:, 2]) & set(val.euler_mm_deg[:, 2])


def test_a_longer_run_goes_on_from_a_shorter_one_to_the_same_data(data, tmp_path):
    assert generate(tmp_path, "--train", "2", "--val", "0", "--seed", "5") == 0
    assert generate(tmp_path, "--train", "6", "--val", "0", "--seed", "5") == 0
    assert read_dataset(tmp_path / "train").sha256 == read_dataset(data / "train").sha256


def test_two_processes_give_the_same_data_as_one(data, tmp_path):
    assert generate(tmp_path, "--train", "6", "--val", "0", "--seed", "5", "--jobs", "2") == 0
    assert read_dataset(tmp_path / "train").sha256 == read_dataset(data / "train").sha256


def test_the_workers_of_a_cluster_give_the_same_data(data, tmp_path):
    with local_cluster() as address:
        options = "--train", "6", "--val", "0", "--seed", "5", "--scheduler", address
        assert generate(tmp_path, *options) == 0
    assert read_dataset(tmp_path / "train").sha256 == read_dataset(data / "train").sha256


def test_a_sensor_file_changes_the_images_and_is_kept_apart(data, tmp_path, capsys):
    sensor = tmp_path / "sensor.yaml"
    sensor.write_text("camera: {rotation_deg: 10.0}\ncollection: {depth_offset: -1.0e-4}\nvariation: {}\n")
    out = tmp_path / "out"
    assert generate(out, "--train", "2", "--val", "0", "--seed", "5", "--sensor", str(sensor)) == 0
    ours, plain = read_dataset(out / "train"), read_dataset(data / "train")
    np.testing.assert_array_equal(ours.euler_mm_deg[:2], plain.euler_mm_deg[:2])
    assert not np.array_equal(ours.images[0], plain.images[0])
    assert generate(data, "--train", "7", "--val", "3", "--seed", "5", "--sensor", str(sensor)) == 1
    assert "was made with another depth_offset, sensor, variation" in capsys.readouterr().err


def test_an_unknown_sensor_is_refused(tmp_path, capsys):
    assert generate(tmp_path, "--sensor", "tactip_nobody") == 1
    assert "tactip_nobody" in capsys.readouterr().err


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition, timeout_s: float = 300.0) -> bool:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline and not condition():
        time.sleep(0.02)
    return condition()


def test_a_worker_that_is_killed_costs_no_sample(data, tmp_path):
    command = [sys.executable, "-m", "tactile_bringup.cli", "data", "generate", str(tmp_path)]
    options = ["--train", "60", "--val", "0", "--seed", "5", "--jobs", "2"]
    journal = tmp_path / "train" / "targets_images.partial.csv"
    with subprocess.Popen([*command, *options], stderr=subprocess.PIPE, text=True) as process:
        assert wait_for(lambda: journal.exists() and journal.read_text().count("\n") > 2)
        os.kill(children(process.pid)[0], signal.SIGKILL)
        said = " ".join(process.stderr.read().split())
    assert process.returncode == 0 and "its process was killed by SIGKILL; it is run again" in said
    samples, whole = read_dataset(tmp_path / "train"), read_dataset(data / "train")
    assert len(samples) == 60 and samples.report.problems == {}
    np.testing.assert_array_equal(samples.images[: len(whole)], whole.images)


def test_a_killed_run_leaves_no_process_behind_and_goes_on_to_the_same_data(data, tmp_path):
    command = [sys.executable, "-m", "tactile_bringup.cli", "data", "generate", str(tmp_path)]
    options = ["--train", "400", "--val", "0", "--seed", "5", "--jobs", "2"]
    journal = tmp_path / "train" / "targets_images.partial.csv"
    with subprocess.Popen([*command, *options], stderr=subprocess.DEVNULL) as process:
        assert wait_for(lambda: journal.exists() and journal.read_text().count("\n") > 5)
        workers = children(process.pid)
        os.kill(process.pid, signal.SIGKILL)
    assert len(workers) >= 2 and wait_for(lambda: not any(map(alive, workers)), 5.0)
    rows = journal.read_text().count("\n") - 1
    assert 5 <= rows < 400
    assert generate(tmp_path, "--train", str(rows + 3), "--val", "0", "--seed", "5") == 0
    resumed, whole = read_dataset(tmp_path / "train"), read_dataset(data / "train")
    number = {name: k for k, name in enumerate(resumed.names)}
    assert len(resumed) >= rows + 3 and len(number) == len(resumed)
    assert resumed.report.problems.keys() <= {"image without its row"}
    for k, name in enumerate(whole.names):
        np.testing.assert_array_equal(resumed.images[number[name]], whole.images[k])
        np.testing.assert_array_equal(resumed.euler_mm_deg[number[name]], whole.euler_mm_deg[k])


def test_another_seed_does_not_mix_into_a_folder(data, capsys):
    assert generate(data, "--train", "7", "--val", "3", "--seed", "6") == 1
    assert "was made with another seed" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options, message",
    [
        (("--set", "dpeth=1"), "did you mean 'depth'"),
        (("--set", "cap_angle=9"), "cap_angle = 9"),
        (("--set", "depth"), "NAME=VALUE"),
        (("--set", "edge.offset=[0,1e-3]"), "edge.offset"),
        (("--edge", "--set", "edge.offest=1"), "did you mean 'offset'"),
        (("--edge", "--set", "curvature=[0,10]"), "must be (0, 0)"),
    ],
)
def test_a_wrong_setting_is_told(tmp_path, capsys, options, message):
    assert generate(tmp_path, *options) == 1
    assert message in capsys.readouterr().err


def test_only_the_part_that_is_asked_for_is_made(tmp_path):
    assert generate(tmp_path, "--train", "2", "--seed", "5") == 0
    assert not (tmp_path / "val").exists()


def test_on_an_edge_labels_lie_in_its_ranges_and_the_sensor_at_rest_is_kept(tmp_path):
    ranges = ("--set", "edge.offset=[1e-3,2e-3]", "--set", "disk_radius=5e-4")
    assert generate(tmp_path, "--train", "4", "--edge", *ranges) == 0
    samples = read_dataset(tmp_path / "train")
    _, y, z, _, _, gamma = samples.euler_mm_deg.T
    assert np.all((y >= 0.5) & (y <= 2.5)) and np.all((z >= 3.0) & (z <= 5.5))
    assert np.ptp(gamma) > 20.0
    assert (tmp_path / "train" / "processed_images" / REFERENCE_NAME).exists()
