"""What a network's last outputs mean: loss, mean and covariance of each kind of head (`network.head`)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor

from tactile_perception.training.settings import NetworkSettings

OUTPUTS = 6
#: Rows and columns of the correlations of `FullGaussianHead`, in the order of its outputs.
LOWER = tuple((row, column) for row in range(OUTPUTS) for column in range(row))
COMPONENTS_OF_MIXTURE = 2
_LOG_TWO_PI = math.log(2.0 * math.pi)


def softbound(x: Tensor, lower: float, upper: float) -> Tensor:
    """Smooth approximation of clamp(x, lower, upper) that never leaves [lower, upper], for lower <= upper.

    The paper's softbound, lower + softplus(x - lower) - softplus(x - upper), rearranged. The paper's own
    rearrangement (appendix "A numerically stable implementation of the softbound function") subtracts x from
    a sum of its size and so loses its bounds for large |x|; here nothing larger than the bounds is formed.
    """
    above_lower = torch.log1p(torch.exp(-torch.abs(x - lower)))
    above_upper = torch.log1p(torch.exp(-torch.abs(x - upper)))
    return torch.clamp(torch.clamp(x, lower, upper) + (above_lower - above_upper), lower, upper)


def mean_nll(labels: Tensor, mean: Tensor, inverse_sigma: Tensor) -> Tensor:
    """Mean negative log-likelihood over a batch (paper, eq. gdn_mean_nll_loss_def)."""
    terms = (inverse_sigma * (labels - mean)) ** 2 - 2.0 * torch.log(inverse_sigma)
    return 0.5 * labels.shape[1] * _LOG_TWO_PI + 0.5 * terms.sum(dim=1).mean()


class Head(ABC):
    """Turns raw outputs (N, outputs) into mean and covariance, and compares them with labels (N, 6).

    Attributes
    ----------
    name : of the loss, for tables and plots
    dropouts : of each raw output
    """

    name = "mean NLL"

    def __init__(self, settings: NetworkSettings) -> None:
        self.settings = settings
        self.dropouts = self._dropouts(settings)

    @property
    def outputs(self) -> int:
        return len(self.dropouts)

    @abstractmethod
    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]: ...

    @abstractmethod
    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        """Raw outputs (outputs,) that say: mean and standard deviations (6,) of the labels."""

    @abstractmethod
    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        """Mean loss over a batch."""

    @abstractmethod
    def mean(self, raw: Tensor) -> Tensor:
        """Means (N, 6)."""

    @abstractmethod
    def covariance(self, raw: Tensor) -> Tensor:
        """Covariances (N, 6, 6) around the means."""

    def _bounded(self, raw: Tensor) -> Tensor:
        lower, upper = self.settings.inverse_sigma_bounds
        return softbound(raw, lower, upper)


class MseHead(Head):
    """The paper's CNN: six numbers and a weighted mean squared error (eq. mse_loss_def); no uncertainty."""

    name = "weighted MSE"

    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        return settings.dropout_mean

    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        return mean

    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        weights = torch.tensor(self.settings.mse_weights, device=raw.device)
        return (weights * (labels - raw) ** 2).sum(dim=1).mean()

    def mean(self, raw: Tensor) -> Tensor:
        return raw

    def covariance(self, raw: Tensor) -> Tensor:
        raise NotImplementedError("a network with the head mse says nothing of its uncertainty")


class GaussianHead(Head):
    """The paper's GDN: means and softbound inverse standard deviations."""

    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        return settings.dropout_mean + settings.dropout_inverse_sigma

    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        return torch.cat([mean, _unbounded(1.0 / sigma.clamp(min=1e-3))])

    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        return mean_nll(labels, self.mean(raw), self.inverse_sigma(raw))

    def mean(self, raw: Tensor) -> Tensor:
        return raw[:, :OUTPUTS]

    def inverse_sigma(self, raw: Tensor) -> Tensor:
        """(N, 6)."""
        return self._bounded(raw[:, OUTPUTS : 2 * OUTPUTS])

    def covariance(self, raw: Tensor) -> Tensor:
        return torch.diag_embed(self.inverse_sigma(raw) ** -2)


class FullGaussianHead(GaussianHead):
    """With correlations: z = (I + L) diag(q) (label - mean) is standard normal, L strictly lower triangular.

    (I + L) diag(q) is the transposed Cholesky factor of the precision; its determinant is the product of q.
    With L = 0 it is the GaussianHead.
    """

    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        return super()._dropouts(settings) + (settings.dropout_correlation,) * len(LOWER)

    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        return torch.cat([super().start(mean, sigma), mean.new_zeros(len(LOWER))])

    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        inverse_sigma = self.inverse_sigma(raw)
        scaled = inverse_sigma * (labels - self.mean(raw))
        whitened = scaled + (self._lower(raw) @ scaled[:, :, None])[:, :, 0]
        terms = 0.5 * (whitened**2).sum(dim=1) - torch.log(inverse_sigma).sum(dim=1)
        return 0.5 * OUTPUTS * _LOG_TWO_PI + terms.mean()

    def covariance(self, raw: Tensor) -> Tensor:
        identity = torch.eye(OUTPUTS, device=raw.device)
        root = torch.linalg.solve_triangular(
            identity + self._lower(raw), identity.expand(len(raw), -1, -1), upper=False, unitriangular=True
        )
        root = root / self.inverse_sigma(raw)[:, :, None]
        return root @ root.mT

    def _lower(self, raw: Tensor) -> Tensor:
        """L (N, 6, 6)."""
        rows, columns = zip(*LOWER, strict=True)
        lower = raw.new_zeros(len(raw), OUTPUTS, OUTPUTS)
        lower[:, rows, columns] = raw[:, 2 * OUTPUTS :]
        return lower


class MixtureHead(Head):
    """Two Gaussians with a probability, as for a contact that stuck or slipped.

    Raw outputs: mean and unbounded 1/sigma of the first, of the second, and the logit of the first. What it
    answers is the Gaussian with the mixture's mean and covariance.
    """

    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        one = settings.dropout_mean + settings.dropout_inverse_sigma
        return one * COMPONENTS_OF_MIXTURE + (settings.dropout_correlation,)

    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        """The two differ a little, or they would stay the same for ever."""
        inverse_sigma = 1.0 / sigma.clamp(min=1e-3)
        narrow, wide = _unbounded(1.3 * inverse_sigma), _unbounded(0.7 * inverse_sigma)
        return torch.cat([mean, narrow, mean, wide, mean.new_zeros(1)])

    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        means, inverse_sigmas, logs = self._parts(raw)
        scaled = inverse_sigmas * (labels[:, None] - means)
        terms = logs - 0.5 * (scaled**2).sum(dim=2) + torch.log(inverse_sigmas).sum(dim=2)
        return 0.5 * OUTPUTS * _LOG_TWO_PI - torch.logsumexp(terms, dim=1).mean()

    def mean(self, raw: Tensor) -> Tensor:
        means, _, logs = self._parts(raw)
        return (logs.exp()[:, :, None] * means).sum(dim=1)

    def covariance(self, raw: Tensor) -> Tensor:
        means, inverse_sigmas, logs = self._parts(raw)
        weights = logs.exp()[:, :, None]
        within = torch.diag_embed((weights * inverse_sigmas**-2).sum(dim=1))
        difference = means[:, 0] - means[:, 1]
        between = weights[:, 0] * weights[:, 1] * difference
        return within + between[:, :, None] * difference[:, None, :]

    def _parts(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Means and inverse deviations (N, 2, 6), logarithms of the probabilities (N, 2)."""
        parts = raw[:, :-1].reshape(len(raw), COMPONENTS_OF_MIXTURE, 2, OUTPUTS)
        logit = raw[:, -1]
        logs = torch.nn.functional.logsigmoid(torch.stack([logit, -logit], dim=1))
        return parts[:, :, 0], self._bounded(parts[:, :, 1]), logs


def make_head(settings: NetworkSettings) -> Head:
    """The head that the settings name."""
    heads: dict[str, type[Head]] = {
        "mse": MseHead,
        "gaussian": GaussianHead,
        "full_gaussian": FullGaussianHead,
        "mixture": MixtureHead,
    }
    return heads[settings.head](settings)


def _unbounded(inverse_sigma: Tensor) -> Tensor:
    """Argument at which softbound gives `inverse_sigma`; softbound is close to softplus here."""
    return inverse_sigma + torch.log(-torch.expm1(-inverse_sigma))
