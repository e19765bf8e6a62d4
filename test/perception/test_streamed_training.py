"""Training beyond one memory and one process: a stream of shards, and several processes by torchrun."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
pytest.importorskip("onnx", reason="export needs onnx (the extra 'train')")
pytest.importorskip("pyarrow", reason="shards need pyarrow (the extra 'parquet')")

from tactile_base.settings import SettingError  # noqa: E402
from tactile_perception.datasets.dataset import DatasetError, open_folder, read_dataset  # noqa: E402
from tactile_perception.datasets.sharding import ShardSettings, write_shards  # noqa: E402
from tactile_perception.estimating.estimator import Estimator  # noqa: E402
from tactile_perception.training import feed  # noqa: E402
from tactile_perception.training.config import TrainConfig  # noqa: E402
from tactile_perception.training.feed import MemoryFeed, ShardFeed, spread_rows  # noqa: E402
from tactile_perception.training.processes import Processes  # noqa: E402
from tactile_perception.training.train import train  # noqa: E402

SIZE = 32
CONFIG = TrainConfig().merged(
    {
        "network": {"image_size": SIZE, "channels": (4, 8), "head_gain": 1.0},
        "training": {
            "batch_size": 8,
            "rise_epochs": 0.0,
            "hold_epochs": 1.0,
            "decay_epochs": 1.0,
            "threads": 1,
            "images_in_memory": 0.0,
            "holdback": 0.25,
        },
        "calibration": {"min_samples": 20},
    }
)
KILLED = -signal.SIGKILL


@pytest.fixture(scope="module")
def shards(training_data, tmp_path_factory):
    """The 96 training samples in 12 groups, the 32 for validation in 4."""
    out = tmp_path_factory.mktemp("shards")
    for part in ("train", "val"):
        write_shards([training_data / part], out / part, ShardSettings(group_rows=8, file_rows=24))
    return out


def process(rank: int, count: int) -> Processes:
    """One of several, as far as it needs no others."""
    result = Processes()
    result.rank, result.count = rank, count
    return result


@pytest.fixture
def streamed(shards):
    source = open_folder(shards / "train")
    source.preprocessing = source.preprocessing.replaced(size=SIZE)
    rows = np.setdiff1d(np.arange(len(source)), [3, 4, 50])
    return ShardFeed(source, rows, np.arange(float(len(rows)))[:, None]), rows, source


def passed(some_feed, rng: int, of: Processes) -> tuple[list[np.ndarray], np.ndarray]:
    """Rows of each batch of a pass, and all images."""
    batches = list(some_feed.batches(8, np.random.default_rng(rng), of))
    return [rows for rows, _ in batches], np.concatenate([images for _, images in batches])


def test_a_pass_has_each_sample_at_most_once_with_its_own_image_in_an_order_of_its_own(streamed, shards):
    stream, rows, _ = streamed
    batches, images = passed(stream, 0, process(0, 1))
    assert len(batches) == stream.steps(8, process(0, 1)) == len(rows) // 8
    chosen = np.concatenate(batches)
    assert len(set(chosen)) == len(chosen) == 8 * len(batches)
    whole = read_dataset(shards / "train", changes={"size": SIZE}).images
    np.testing.assert_array_equal(images, whole[rows[chosen]])
    again, other = (np.concatenate(passed(stream, seed, process(0, 1))[0]) for seed in (0, 1))
    np.testing.assert_array_equal(chosen, again)
    assert not np.array_equal(chosen, other)
    first = [set(batch // 8) for batch in batches]  # groups: of more than one in a batch
    assert np.mean([len(groups) for groups in first]) > 3


@pytest.mark.parametrize("in_memory", [False, True])
def test_processes_have_as_many_batches_and_no_sample_in_common(streamed, in_memory):
    stream, rows, _ = streamed
    if in_memory:
        stream = MemoryFeed(np.zeros((len(rows), SIZE, SIZE), np.uint8), stream.labels)
    three = [process(rank, 3) for rank in range(3)]
    parts = [list(stream.batches(9, np.random.default_rng(5), one)) for one in three]
    assert len({len(part) for part in parts}) == 1
    assert {len(rows) for part in parts for rows, _ in part} == {3}
    all_rows = np.concatenate([rows for part in parts for rows, _ in part])
    assert len(set(all_rows)) == len(all_rows) >= 0.8 * len(rows)


def test_too_many_processes_are_refused(streamed):
    stream, _, _ = streamed
    with pytest.raises(DatasetError, match=r"12 groups of samples, fewer than 13 processes"):
        stream.steps(13, process(0, 13))
    for batch_size, count in ((16, 3), (4, 4), (128, 2)):
        with pytest.raises(SettingError, match="is the batch of all"):
            process(0, count).share(batch_size, 96)
    assert process(0, 1).share(128, 96) == 128


def test_some_rows_are_of_few_groups(streamed):
    _, rows, source = streamed
    some = spread_rows(source, rows, 20)
    assert len(some) == 20 and set(some) <= set(rows) and (np.diff(some) > 0).all()
    assert len(set(some // 8)) <= 4
    np.testing.assert_array_equal(spread_rows(source, rows, len(rows)), rows)


def test_a_streamed_run_learns_with_few_samples_in_memory(shards, tmp_path, monkeypatch):
    monkeypatch.setattr(feed, "SAMPLED", 20)
    network = {"image_size": 64, "channels": (8, 16, 32, 32), "batch_norm_momentum": 0.2}
    longer = CONFIG.merged({"training": {"decay_epochs": 14.0}, "network": network})
    result = train(shards, tmp_path / "streamed", longer)
    metadata = Estimator(result.model_path).metadata
    assert metadata.training_data["samples"] == 72 and metadata.training_data["held_out"] == 24
    assert metadata.training_data["sha256"] == open_folder(shards / "train").sha256
    assert "of 96 samples in shards 40 are in memory" in (tmp_path / "streamed" / "data.txt").read_text()
    labels = read_dataset(shards / "val").labels
    guess = np.abs(labels - np.median(labels, axis=0)).mean(axis=0)
    assert result.best.mae[2] < 0.7 * guess[2], "depth"


GRADIENT = """
import torch
from tactile_perception.training.processes import Processes
with Processes() as processes:
    torch.manual_seed(processes.rank)  # the first's weights count
    layer = torch.nn.Linear(3, 1)
    joined = processes.joined(layer, partly_used=False)
    joined(torch.tensor([[1.0 + processes.rank, 2.0, 3.0]])).sum().backward()
    mean = processes.mean(float(processes.rank))
    told = processes.told({"rank": processes.rank})
    torch.manual_seed(0)
    same = torch.equal(layer.weight, torch.nn.Linear(3, 1).weight)
    if not processes.first:
        print(layer.weight.grad.tolist(), mean, told, same, flush=True)
"""


def torchrun(*command: str, **options) -> subprocess.Popen:
    """Two processes of this machine that train together."""
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [*torchrun, *command], text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        env=environment, start_new_session=True, **options,
    )  # fmt: skip


def test_gradients_are_the_mean_of_the_processes_and_the_first_tells_the_others(tmp_path):
    script = tmp_path / "gradient.py"
    script.write_text(GRADIENT)
    run = torchrun(str(script))
    said, _ = run.communicate()
    assert run.returncode == 0, said
    assert "[[1.5, 2.0, 3.0]] 0.5 {'rank': 0} True" in said


def started(shards: Path, out: Path, config: Path) -> subprocess.Popen:
    tactile = Path(sys.executable).with_name("tactile")
    command = (sys.executable, "-m", "tactile_bringup.cli") if not tactile.exists() else (str(tactile),)
    return torchrun("--no-python", *command, "train", str(shards), "--out", str(out), "--config", str(config))


def test_two_processes_train_and_a_kill_loses_one_epoch_at_most(shards, tmp_path):
    config = tmp_path / "config.yaml"
    write_config(config, CONFIG.merged({"training": {"decay_epochs": 3.0}}))
    whole = started(shards, tmp_path / "whole", config)
    said, _ = whole.communicate()
    assert whole.returncode == 0, said
    assert said.count("best") <= 6 and said.count("model:") == 1, "one of the processes reports"

    out = tmp_path / "killed"
    run = started(shards, out, config)
    epochs = out / "epochs.csv"
    while not (epochs.exists() and len(epochs.read_text().splitlines()) > 2):
        assert run.poll() is None, run.communicate()[0]
        time.sleep(0.01)
    os.killpg(run.pid, signal.SIGKILL)
    assert run.wait() == KILLED
    for pid in running(out):  # torchrun starts a session for each process
        os.kill(pid, signal.SIGKILL)
    run.communicate()
    assert not (out / "result.json").exists()
    again = started(shards, out, config)
    said, _ = again.communicate()
    assert again.returncode == 0 and "resumed after epoch" in said, said
    first, second = (columns(tmp_path / name / "epochs.csv") for name in ("whole", "killed"))
    assert first == second


def write_config(path: Path, config: TrainConfig) -> None:
    import yaml

    path.write_text(yaml.safe_dump(config.plain()))


def running(out: Path) -> list[int]:
    """Processes that have this path in their command line."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if str(out).encode() in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def columns(table: Path) -> list[list[str]]:
    """Without the times."""
    return [line.split(",")[:-2] for line in table.read_text().splitlines()]
