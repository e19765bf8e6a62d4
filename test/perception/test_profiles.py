"""Profiles: those that come with the package, errors in a file of one's own, and training by one."""

import pytest

from tactile_base.config_paths import config_path
from tactile_base.settings import SettingError
from tactile_base.yaml_file import read_yaml
from tactile_bringup.cli import main as tactile
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.training.config import Profile, profile, profiles, read_profiles


@pytest.mark.parametrize("name", ["rate_120hz", "rate_60hz", "accuracy"])
def test_profiles_name_a_network_that_can_be_built(name):
    pytest.importorskip("torch", reason="building a network needs PyTorch (the extra 'train')")
    from tactile_perception.training.config import TrainConfig
    from tactile_perception.training.network import PoseNetwork

    chosen = profile(name)
    config = TrainConfig.from_file(chosen.config).merged({"network": chosen.network})
    assert sum(p.numel() for p in PoseNetwork(config.network).parameters()) > 10_000
    assert chosen.use and chosen.threads >= 1


def test_the_networks_that_the_benchmark_compares_can_be_built():
    pytest.importorskip("torch", reason="building a network needs PyTorch (the extra 'train')")
    from tactile_perception.training.config import TrainConfig
    from tactile_perception.training.network import PoseNetwork

    dial = read_yaml(config_path("perception/dial.yaml"))
    training = TrainConfig.from_file(config_path(f"perception/{dial.text('config')}"))
    assert training.training.holdback > 0.0  # else there would be nothing to calibrate on
    for network in dial.sections("networks").values():
        PoseNetwork(training.merged({"network": network.values}).network)


def test_faster_profiles_are_quantized():
    assert {name: chosen.quantized for name, chosen in profiles().items()} == {
        "rate_120hz": True, "rate_60hz": True, "accuracy": False,
    }  # fmt: skip


def test_an_unknown_profile_is_answered_with_those_there_are():
    with pytest.raises(SettingError, match=r"'rate_120' \(did you mean 'rate_120hz'\?\); valid: accuracy"):
        profile("rate_120")


@pytest.mark.parametrize(
    "text, message",
    [
        ("a: {config: gdn_symmetry.yaml}", r":1: a\.use is missing"),
        ("a: {use: x, config: gdn_symetry.yaml}", r":1: .*did you mean 'gdn_symmetry.yaml'"),
        (
            "a:\n  use: x\n  config: gdn_symmetry.yaml\n  threads: 0.5",
            r":4: a\.threads = 0.5: must be a whole",
        ),
        ("a: {use: x, config: gdn_symmetry.yaml, arithmetic: int4}", "valid: fp32, int8"),
        ("a: {use: x, config: gdn_symmetry.yaml, size: 3}", "unknown name 'size'"),
    ],
)
def test_what_is_wrong_in_a_file_is_named_with_its_line(tmp_path, text, message):
    file = tmp_path / "profiles.yaml"
    file.write_text(text + "\n")
    with pytest.raises(SettingError, match=message):
        read_profiles(file)


@pytest.fixture
def train_small(tmp_path, training_data, monkeypatch):
    """`tactile train` by a profile of 8-bit integers for a small network; arguments are further words."""
    pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
    from tactile_bringup.commands import train as train_command

    config = tmp_path / "short.yaml"
    config.write_text("training: {rise_epochs: 1, hold_epochs: 0, decay_epochs: 0, threads: 1}\n")
    network = {"image_size": 32, "channels": [4, 8, 8]}
    small = Profile("small", "tests", config, network, "int8")
    monkeypatch.setattr(train_command, "profile", lambda name: small)

    def train(*words: object) -> int:
        out = ("--out", tmp_path / "run", "--profile", "small", "--limit", 32)
        return tactile(["train", *map(str, (training_data, *out, *words))])

    return train


def test_training_by_a_profile_leaves_its_network_in_its_arithmetic(tmp_path, train_small, capsys):
    installed = tmp_path / "new" / "installed.onnx"
    assert train_small("--install", installed) == 0
    metadata = Estimator(installed).metadata
    assert metadata.training["network"]["channels"] == [4, 8, 8]
    assert metadata.preprocessing.size == 32
    assert metadata.training["quantization"]["weights"] == "int8"
    assert str(tmp_path / "run" / "model_int8.onnx") in capsys.readouterr().out.replace("\n", "")


def test_a_training_interrupted_before_its_quantization_goes_on_with_it(tmp_path, train_small, capsys):
    assert train_small() == 0
    trained, quantized = (tmp_path / "run" / name for name in ("model.onnx", "model_int8.onnx"))
    before = trained.stat().st_mtime_ns, quantized.read_bytes()
    quantized.unlink()
    assert train_small("--set", "training.seed=1") == 1
    assert "training.seed = 0, not 1" in capsys.readouterr().err
    assert train_small() == 0
    assert (trained.stat().st_mtime_ns, quantized.read_bytes()) == before
    assert train_small() == 1
    assert "holds another run" in capsys.readouterr().err


def test_each_of_many_runs_by_a_profile_is_quantized_once(tmp_path, train_small, capsys):
    assert train_small("--repeat", 2) == 0
    printed = capsys.readouterr().out.replace("\n", "")
    models = [tmp_path / "run" / f"seed_{seed}" / "model_int8.onnx" for seed in (0, 1)]
    for seed, model in enumerate(models):
        assert f"quantized model: {model}" in printed
        assert Estimator(model).metadata.training["quantization"]["weights"] == "int8"
        assert Estimator(model).metadata.training["training"]["seed"] == seed
    models[1].unlink()
    before = models[0].stat().st_mtime_ns
    assert train_small("--repeat", 2) == 0
    assert models[1].exists() and models[0].stat().st_mtime_ns == before


def test_a_profile_and_a_file_exclude_each_other(tmp_path, capsys):
    with pytest.raises(SystemExit):
        tactile(["train", "data", "--out", "x", "--profile", "accuracy", "--config", "x.yaml"])
    assert "not allowed with" in capsys.readouterr().err
