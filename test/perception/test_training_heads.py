"""Networks and their heads: losses, answers, and the model files that say the same. Needs PyTorch."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")
pytest.importorskip("onnx", reason="export needs onnx (the extra 'train')")

from tactile_perception.estimating.estimator import Estimator  # noqa: E402
from tactile_perception.estimating.model_metadata import ModelMetadata  # noqa: E402
from tactile_perception.estimating.preprocessing import PreprocessingSettings  # noqa: E402
from tactile_perception.training.convolutions import ConvBlock, FirstBlock  # noqa: E402
from tactile_perception.training.export import export_onnx  # noqa: E402
from tactile_perception.training.heads import make_head, softbound  # noqa: E402
from tactile_perception.training.network import PoseNetwork  # noqa: E402
from tactile_perception.training.output_layer import MultiDropoutLinear  # noqa: E402
from tactile_perception.training.settings import HEADS, NetworkSettings  # noqa: E402

SMALL = NetworkSettings(image_size=32, channels=(4, 6, 8))
UNCERTAIN = [head for head in HEADS if head != "mse"]


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def raw_answers(head, count: int = 4) -> torch.Tensor:
    """Outputs as a trained head might give them."""
    generator = torch.Generator().manual_seed(1)
    return torch.randn(count, head.outputs, generator=generator, dtype=torch.float64) + 1.0


def test_loss_is_the_mean_negative_log_likelihood():
    from scipy.stats import norm

    rng = np.random.default_rng(1)
    labels, mean, sigma = rng.normal(size=(5, 6)), rng.normal(size=(5, 6)), rng.uniform(0.1, 3.0, (5, 6))
    expected = -norm.logpdf(labels, mean, sigma).sum(axis=1).mean()
    unbounded = 1.0 / sigma + np.log(-np.expm1(-1.0 / sigma))  # what softplus makes 1/sigma of
    raw = torch.tensor(np.hstack([mean, unbounded]))
    loss = make_head(NetworkSettings()).loss(torch.tensor(labels), raw)
    assert loss.item() == pytest.approx(expected, rel=1e-5)


def test_each_output_has_its_own_dropout():
    torch.manual_seed(0)
    dropouts = (0.7, 0.0, 0.4)
    head = MultiDropoutLinear(2000, dropouts).double().train()
    with torch.no_grad():
        head.weight[:] = 1.0 / 2000
        head.bias[:] = 0.0
    features = torch.ones(1, 2000, dtype=torch.float64)
    answers = torch.stack([head(features)[0] for _ in range(200)]).detach().numpy()
    np.testing.assert_allclose(answers.mean(axis=0), 1.0, atol=0.02)
    expected = [np.sqrt(p / (1 - p) / 2000) for p in dropouts]
    np.testing.assert_allclose(answers.std(axis=0), expected, rtol=0.2, atol=1e-9)


def test_gradients_of_dropped_features_are_those_of_the_kept_ones():
    torch.manual_seed(4)
    head = MultiDropoutLinear(500, (0.0, 0.5), gain=0.5).train()
    with torch.no_grad():
        head.weight[:] = torch.tensor([[1.0], [3.0]])
    features = torch.ones(1, 500, requires_grad=True)
    answer = head(features)
    (gradient,) = torch.autograd.grad(answer[0, 1], features, retain_graph=True)
    kept = gradient[0] != 0.0
    assert 0.4 < kept.float().mean() < 0.6
    torch.testing.assert_close(gradient[0][kept], torch.full((int(kept.sum()),), 0.5 * 3.0 / 0.5))
    torch.testing.assert_close(answer[0, 1], gradient.sum())
    (weight_gradient,) = torch.autograd.grad(answer[0, 1], head.weight)
    torch.testing.assert_close(weight_gradient[1] != 0.0, kept)
    assert torch.all(weight_gradient[0] == 0.0)


def test_the_cnn_has_one_dropout_for_all_outputs():
    torch.manual_seed(0)
    head = PoseNetwork(SMALL.replaced(head="mse", dropout_mean=(0.5,) * 6)).head.train()
    with torch.no_grad():
        head.weight[:] = 1.0
    answers = head(torch.ones(1, head.weight.shape[1]))[0]
    assert torch.all(answers == answers[0]) and answers[0] != head.weight.shape[1] * head.gain


def test_dropout_is_off_in_evaluation():
    torch.manual_seed(0)
    head = MultiDropoutLinear(50, (0.7, 0.4), gain=0.5).double()
    features = torch.rand(3, 50, dtype=torch.float64)
    torch.nn.init.normal_(head.weight)
    expected = features @ (0.5 * head.weight).T + head.bias
    torch.testing.assert_close(head.eval()(features), expected)
    assert not torch.allclose(head.train()(features), expected)


def test_an_untrained_network_starts_from_the_labels_statistics():
    torch.manual_seed(0)
    network = PoseNetwork(NetworkSettings(image_size=64))
    labels = torch.randn(500, 6) * torch.tensor([2.0, 2, 1, 0.1, 0.1, 0.05]) + 3.0
    network.start_from(labels)
    raw = network.eval()(torch.rand(2, 1, 64, 64))
    torch.testing.assert_close(network.distribution.mean(raw)[0], labels.mean(dim=0), rtol=1e-4, atol=1e-4)
    sigma = network.distribution.covariance(raw)[0].diagonal().sqrt()
    torch.testing.assert_close(sigma, labels.std(dim=0), rtol=1e-3, atol=1e-3)


def test_loss_of_the_cnn_is_the_papers_weighted_squared_error():
    head = make_head(SMALL.replaced(head="mse"))
    labels, answers = torch.zeros(2, 6), torch.tensor([[1.0, 0, 0, 0.1, 0, 0], [0, 2.0, 0, 0, 0, 0.2]])
    assert head.loss(labels, answers).item() == pytest.approx((1 + 100 * 0.01 + 4 + 100 * 0.04) / 2, rel=1e-4)


@pytest.mark.parametrize("name", ["gaussian", "full_gaussian"])
def test_loss_of_a_gaussian_is_that_of_scipy(name):
    from scipy.stats import multivariate_normal

    head = make_head(SMALL.replaced(head=name))
    raw = raw_answers(head)
    labels = torch.from_numpy(np.random.default_rng(2).normal(size=(4, 6)))
    expected = [
        -multivariate_normal.logpdf(label, mean, covariance)
        for label, mean, covariance in zip(
            labels.numpy(), head.mean(raw).numpy(), head.covariance(raw).numpy(), strict=True
        )
    ]
    assert head.loss(labels, raw).item() == pytest.approx(np.mean(expected), rel=1e-9)


def test_mixture_has_the_loss_mean_and_covariance_of_its_samples():
    from scipy.stats import norm

    head = make_head(SMALL.replaced(head="mixture"))
    raw = raw_answers(head, 1)
    mean0, unbounded0, mean1, unbounded1 = raw[0, :-1].reshape(4, 6).numpy()
    sigmas = [1.0 / softbound(torch.tensor(v), 1e-6, 1e6).numpy() for v in (unbounded0, unbounded1)]
    first = 1.0 / (1.0 + np.exp(-raw[0, -1].item()))
    label = np.linspace(-0.5, 2.0, 6)
    density = first * norm.pdf(label, mean0, sigmas[0]).prod()
    density += (1.0 - first) * norm.pdf(label, mean1, sigmas[1]).prod()
    assert head.loss(torch.tensor(label)[None], raw).item() == pytest.approx(-np.log(density), rel=1e-6)
    rng = np.random.default_rng(2)
    of_first = rng.random((200_000, 1)) < first
    drawn = np.where(
        of_first, rng.normal(mean0, sigmas[0], (200_000, 6)), rng.normal(mean1, sigmas[1], (200_000, 6))
    )
    np.testing.assert_allclose(head.mean(raw)[0], drawn.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(head.covariance(raw)[0], np.cov(drawn.T), atol=0.03)


@pytest.mark.parametrize("stride, channels", [(1, 1), (2, 1), (1, 3), (2, 3)])
def test_first_block_is_convolution_and_normalization(stride, channels):
    """Outputs, gradients and running statistics of the block that normalizes by its input's statistics."""
    torch.manual_seed(0)
    fast = FirstBlock(stride, 5, 0.1, channels).double()
    images = torch.rand(3, channels, 16, 16, dtype=torch.float64)
    plain = ConvBlock(channels * stride * stride, 5, 0.1).double()
    plain.load_state_dict(fast.state_dict())
    expected = plain(torch.nn.functional.pixel_unshuffle(images, stride))
    answer = fast(images)
    torch.testing.assert_close(answer, expected, rtol=1e-5, atol=1e-6)
    weights = torch.rand_like(expected)
    for output in (answer, expected):
        (output * weights).sum().backward()
    for name, parameter in fast.named_parameters():
        torch.testing.assert_close(parameter.grad, plain.get_parameter(name).grad, rtol=1e-4, atol=1e-5)
    for name, value in fast.named_buffers():
        torch.testing.assert_close(value, plain.get_buffer(name), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("stride, unpooled, channels", [(1, 0, 1), (2, 0, 1), (1, 1, 1), (2, 1, 3)])
@pytest.mark.parametrize("name", HEADS)
def test_exported_model_answers_like_the_network(tmp_path, name, stride, unpooled, channels):
    torch.manual_seed(3)
    settings = SMALL.replaced(head=name, first_stride=stride, channels=(4, 6), unpooled_blocks=unpooled)
    network = PoseNetwork(settings, channels=channels)
    with torch.no_grad():
        network.head.weight.normal_(std=0.2)
        network(torch.rand(8, channels, 32, 32))  # running statistics
        network.start_from(torch.randn(100, 6))
    network.eval()
    sigma = np.linspace(0.1, 0.6, 6)
    levels = {"color": True, "threshold_method": "none"} if channels == 3 else {}
    metadata = ModelMetadata(PreprocessingSettings(size=32, **levels), {}, {})
    estimator = Estimator(export_onnx(network, tmp_path / "m.onnx", metadata, sigma))
    images = np.random.default_rng(0).random((3, channels, 32, 32), dtype=np.float32)
    mean, covariance = estimator.predict(images)
    with torch.inference_mode():
        raw = network(torch.from_numpy(images))
        expected = np.tile(np.diag(sigma**2), (3, 1, 1))
        if name != "mse":
            expected = network.distribution.covariance(raw).numpy()
    np.testing.assert_allclose(mean, network.distribution.mean(raw).numpy(), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(covariance, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("head", UNCERTAIN)
def test_exported_model_holds_the_bounds_of_sigma_and_stays_a_gaussian(tmp_path, head):
    network = PoseNetwork(NetworkSettings(image_size=16, channels=(2, 2), head=head)).eval()
    for value, bound in ((-1e9, 1e-6), (1e9, 1e6)):
        with torch.no_grad():
            network.head.bias[6:12] = value
            if head == "mixture":
                network.head.bias[18:24] = value
        metadata = ModelMetadata(PreprocessingSettings(size=16), {}, {})
        estimator = Estimator(export_onnx(network, tmp_path / "m.onnx", metadata))
        covariance = estimator.predict(np.zeros((1, 1, 16, 16), np.float32))[1][0]
        np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 1.0 / bound, rtol=1e-4)
        estimate = estimator.estimate(np.zeros((480, 640), np.uint8))
        assert np.all(np.linalg.eigvalsh(estimate.cov) > 0.0)


def test_blocks_without_pooling_leave_a_larger_map_and_the_first_always_pools():
    sides = {n: SMALL.replaced(unpooled_blocks=n).last_side for n in range(4)}
    assert sides == {0: 4, 1: 8, 2: 16, 3: 16}
    network = PoseNetwork(SMALL.replaced(unpooled_blocks=1))
    assert network.base(torch.zeros(1, 1, 32, 32)).shape == (1, 8, 8, 8)
    assert [block.pooled for block in network.base] == [True, True, False]


def test_a_network_without_uncertainty_is_not_exported_without_its_errors(tmp_path):
    network = PoseNetwork(SMALL.replaced(head="mse"))
    with pytest.raises(ValueError, match="needs the standard deviations of its errors"):
        export_onnx(network, tmp_path / "m.onnx", ModelMetadata(PreprocessingSettings(size=32), {}, {}))


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"image_size": 16, "channels": (2,) * 5}, "to nothing"),
        ({"image_size": 33, "first_stride": 2}, "multiple"),
    ],
)
def test_an_impossible_network_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        PoseNetwork(SMALL.replaced(**settings))
