"""What a network's last outputs mean: loss, mean and covariance of each kind of head (`network.head`).

Labels may be NaN: what is not labelled has no part in the loss, neither the mean that the network tells of it
nor its deviation. An angle that goes all round is told by two outputs, its sine and its cosine.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor

from tactile_base.settings import SettingError
from tactile_perception.estimating.contact_model import POSE, SURFACE, ContactModel
from tactile_perception.training.settings import NetworkSettings

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


def lower_places(size: int) -> tuple[tuple[int, int], ...]:
    """Rows and columns of the correlations of `FullGaussianHead`, in the order of its outputs."""
    return tuple((row, column) for row in range(size) for column in range(row))


def for_all(values: tuple[float, ...], model: ContactModel) -> tuple[float, ...]:
    """A setting of the six components for all quantities of a model: a force is as the depth."""
    return (*values, *values[2:3] * (model.size - POSE))


class Head(ABC):
    """Turns raw outputs (N, outputs) into mean and covariance, and compares them with labels (N, K).

    Attributes
    ----------
    name : of the loss, for tables and plots
    model : what its K quantities are
    dropouts : of each raw output
    """

    name = "mean NLL"

    def __init__(self, settings: NetworkSettings, model: ContactModel = SURFACE) -> None:
        self.settings, self.model = settings, model
        self.means = model.size + len(model.turning)  # numbers that tell a mean: the cosines come last
        self.dropouts = self._dropouts(settings)

    @property
    def outputs(self) -> int:
        return len(self.dropouts)

    @abstractmethod
    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]: ...

    @abstractmethod
    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        """Raw outputs (outputs,) that say: mean and standard deviations (K,) of the labels."""

    @abstractmethod
    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        """Mean loss over a batch."""

    @abstractmethod
    def mean(self, raw: Tensor) -> Tensor:
        """Means (N, K)."""

    @abstractmethod
    def covariance(self, raw: Tensor) -> Tensor:
        """Covariances (N, K, K) around the means."""

    def error(self, labels: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Labels - mean (..., K), 0 where there is no label, and where there is one, as 0 and 1."""
        labelled = torch.isfinite(labels)
        error = torch.where(labelled, labels - mean, 0.0)
        for k in self.model.turning:  # the short way round
            error[..., k] = torch.remainder(error[..., k] + math.pi, 2.0 * math.pi) - math.pi
        return error, labelled.to(mean.dtype).expand_as(error)

    def _bounded(self, raw: Tensor) -> Tensor:
        lower, upper = self.settings.inverse_sigma_bounds
        return softbound(raw, lower, upper)

    def _mean_dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        dropouts = for_all(settings.dropout_mean, self.model)
        return dropouts + tuple(dropouts[k] for k in self.model.turning)

    def _mean_start(self, mean: Tensor) -> Tensor:
        turning = list(self.model.turning)
        start = torch.cat([mean, torch.cos(mean[turning])])
        start[turning] = torch.sin(mean[turning])
        return start

    def _mean(self, raw: Tensor) -> Tensor:
        """Means (N, K) of the raw outputs that tell them (N, means)."""
        mean = raw[:, : self.model.size]
        for place, k in enumerate(self.model.turning):
            angle = torch.atan2(raw[:, k], raw[:, self.model.size + place])
            mean = torch.cat([mean[:, :k], angle[:, None], mean[:, k + 1 :]], dim=1)
        return mean


class MseHead(Head):
    """The paper's CNN: one number a quantity and a weighted mean squared error (eq. mse_loss_def)."""

    name = "weighted MSE"

    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        return self._mean_dropouts(settings)

    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        return self._mean_start(mean)

    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        weights = torch.tensor(for_all(self.settings.mse_weights, self.model), device=raw.device)
        return (weights * self.error(labels, self.mean(raw))[0] ** 2).sum(dim=1).mean()

    def mean(self, raw: Tensor) -> Tensor:
        return self._mean(raw)

    def covariance(self, raw: Tensor) -> Tensor:
        raise NotImplementedError("a network with the head mse says nothing of its uncertainty")


class GaussianHead(Head):
    """The paper's GDN: means and softbound inverse standard deviations (eq. gdn_mean_nll_loss_def)."""

    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        return self._mean_dropouts(settings) + for_all(settings.dropout_inverse_sigma, self.model)

    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        return torch.cat([self._mean_start(mean), _unbounded(1.0 / sigma.clamp(min=1e-3))])

    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        error, labelled = self.error(labels, self.mean(raw))
        inverse_sigma = self.inverse_sigma(raw)
        terms = (inverse_sigma * error) ** 2 - 2.0 * torch.log(inverse_sigma) * labelled
        return 0.5 * (terms.sum(dim=1) + _LOG_TWO_PI * labelled.sum(dim=1)).mean()

    def mean(self, raw: Tensor) -> Tensor:
        return self._mean(raw[:, : self.means])

    def inverse_sigma(self, raw: Tensor) -> Tensor:
        """(N, K)."""
        return self._bounded(raw[:, self.means : self.means + self.model.size])

    def covariance(self, raw: Tensor) -> Tensor:
        return torch.diag_embed(self.inverse_sigma(raw) ** -2)


class FullGaussianHead(GaussianHead):
    """With correlations: z = (I + L) diag(q) (label - mean) is standard normal, L strictly lower triangular.

    (I + L) diag(q) is the transposed Cholesky factor of the precision; its determinant is the product of q.
    With L = 0 it is the GaussianHead. A quantity without labels correlates with none.
    """

    def __init__(self, settings: NetworkSettings, model: ContactModel = SURFACE) -> None:
        self.lower = lower_places(model.size)
        super().__init__(settings, model)

    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        return super()._dropouts(settings) + (settings.dropout_correlation,) * len(self.lower)

    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        return torch.cat([super().start(mean, sigma), mean.new_zeros(len(self.lower))])

    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        error, labelled = self.error(labels, self.mean(raw))
        inverse_sigma = self.inverse_sigma(raw)
        scaled = inverse_sigma * error
        whitened = (scaled + (self._lower(raw) @ scaled[:, :, None])[:, :, 0]) * labelled
        terms = 0.5 * (whitened**2).sum(dim=1) - (torch.log(inverse_sigma) * labelled).sum(dim=1)
        return (terms + 0.5 * _LOG_TWO_PI * labelled.sum(dim=1)).mean()

    def covariance(self, raw: Tensor) -> Tensor:
        identity = torch.eye(self.model.size, device=raw.device)
        root = torch.linalg.solve_triangular(
            identity + self._lower(raw), identity.expand(len(raw), -1, -1), upper=False, unitriangular=True
        )
        root = root / self.inverse_sigma(raw)[:, :, None]
        return root @ root.mT

    def _lower(self, raw: Tensor) -> Tensor:
        """L (N, K, K)."""
        rows, columns = zip(*self.lower, strict=True)
        lower = raw.new_zeros(len(raw), self.model.size, self.model.size)
        lower[:, rows, columns] = raw[:, self.means + self.model.size :]
        if self.model.unknown:
            known = torch.from_numpy(self.model.known).to(raw)
            lower = lower * torch.outer(known, known)
        return lower


class MixtureHead(Head):
    """Two Gaussians with a probability, as for a contact that stuck or slipped.

    Raw outputs: mean and unbounded 1/sigma of the first, of the second, and the logit of the first. What it
    answers is the Gaussian with the mixture's mean and covariance.
    """

    def _dropouts(self, settings: NetworkSettings) -> tuple[float, ...]:
        if self.model.turning:
            name = self.model.quantity_names[self.model.turning[0]]
            raise SettingError(
                "network.head = 'mixture': the mean of two angles is none where they go all round, as "
                f"{name} of the contact model '{self.model.name}' does; take gaussian or full_gaussian"
            )
        one = self._mean_dropouts(settings) + for_all(settings.dropout_inverse_sigma, self.model)
        return one * COMPONENTS_OF_MIXTURE + (settings.dropout_correlation,)

    def start(self, mean: Tensor, sigma: Tensor) -> Tensor:
        """The two differ a little, or they would stay the same for ever."""
        inverse_sigma = 1.0 / sigma.clamp(min=1e-3)
        narrow, wide = _unbounded(1.3 * inverse_sigma), _unbounded(0.7 * inverse_sigma)
        return torch.cat([mean, narrow, mean, wide, mean.new_zeros(1)])

    def loss(self, labels: Tensor, raw: Tensor) -> Tensor:
        means, inverse_sigmas, logs = self._parts(raw)
        error, labelled = self.error(labels[:, None], means)
        scaled = inverse_sigmas * error
        terms = logs - 0.5 * (scaled**2).sum(dim=2) + (torch.log(inverse_sigmas) * labelled).sum(dim=2)
        constant = 0.5 * _LOG_TWO_PI * labelled[:, 0].sum(dim=1)
        return (constant - torch.logsumexp(terms, dim=1)).mean()

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
        """Means and inverse deviations (N, 2, K), logarithms of the probabilities (N, 2)."""
        parts = raw[:, :-1].reshape(len(raw), COMPONENTS_OF_MIXTURE, 2, self.model.size)
        logit = raw[:, -1]
        logs = torch.nn.functional.logsigmoid(torch.stack([logit, -logit], dim=1))
        return parts[:, :, 0], self._bounded(parts[:, :, 1]), logs


def make_head(settings: NetworkSettings, model: ContactModel = SURFACE) -> Head:
    """The head that the settings name."""
    heads: dict[str, type[Head]] = {
        "mse": MseHead,
        "gaussian": GaussianHead,
        "full_gaussian": FullGaussianHead,
        "mixture": MixtureHead,
    }
    return heads[settings.head](settings, model)


def _unbounded(inverse_sigma: Tensor) -> Tensor:
    """Argument at which softbound gives `inverse_sigma`; softbound is close to softplus here."""
    return inverse_sigma + torch.log(-torch.expm1(-inverse_sigma))
