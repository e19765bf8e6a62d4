"""Settings of network and training; defaults are the paper's, where the paper gives a value."""

from __future__ import annotations

from dataclasses import dataclass

from tactile_filter.settings import SettingError, Settings, setting


@dataclass(frozen=True)
class GdnSettings(Settings):
    """The Gaussian density network of the paper's "Gaussian Density Networks"."""

    image_size: int = setting(128, unit="px", lower=16, upper=512, doc="side of the square input image")
    channels: tuple[int, ...] = setting(
        (16, 32, 64, 128, 256), lower=1, doc="features of each block: convolution, batch norm, ReLU, max-pool"
    )
    batch_norm_momentum: float = setting(
        0.01, lower=1e-4, upper=1.0, doc="weight of a batch in the running statistics (0.01: Keras's default)"
    )
    head_gain: float = setting(
        0.1, lower=1e-4, upper=1.0, doc="factor on the features before the output layer; the paper's: 1"
    )
    dropout_mean: tuple[float, ...] = setting(
        (0.7, 0.7, 0.1, 0.0, 0.0, 0.4), lower=0.0, upper=0.99, length=6, doc="dropout of each mean output"
    )
    dropout_inverse_sigma: tuple[float, ...] = setting(
        (0.1, 0.1, 0.0, 0.0, 0.0, 0.05), lower=0.0, upper=0.99, length=6, doc="dropout of each 1/sigma output"
    )
    inverse_sigma_bounds: tuple[float, ...] = setting(
        (1e-6, 1e6), lower=1e-12, length=2, doc="softbound of the inverse standard deviations (1/mm, 1/rad)"
    )


@dataclass(frozen=True)
class TrainingSettings(Settings):
    """Optimizer, schedule and stopping of the paper; what concerns speed rather than result comes last."""

    batch_size: int = setting(16, lower=1, doc="samples a step")
    learning_rate_start: float = setting(1e-5, lower=0.0, doc="first learning rate of the linear rise")
    learning_rate_peak: float = setting(1e-3, lower=0.0, doc="learning rate after the rise")
    learning_rate_end: float = setting(1e-7, lower=0.0, doc="learning rate at the end of the decay")
    rise_epochs: float = setting(3.0, lower=0.0, doc="length of the linear rise")
    hold_epochs: float = setting(1.0, lower=0.0, doc="time at the peak")
    decay_epochs: float = setting(50.0, lower=0.0, doc="length of the polynomial decay")
    decay_power: float = setting(0.5, lower=0.0, doc="exponent of (1 - e / decay_epochs)")
    patience: int = setting(25, lower=1, doc="epochs without a better validation loss before stopping early")
    seed: int = setting(0, lower=0, doc="seed of weights, shuffling and dropout")
    precision: str = setting("bf16", choices=("fp32", "bf16"), doc="arithmetic of the convolutional base")
    channels_last: bool = setting(True, doc="memory layout that CPU kernels prefer")
    threads: int = setting(0, lower=0, doc="CPU threads; 0: PyTorch's choice")
    max_minutes: float = setting(
        0.0,
        lower=0.0,
        doc="stop in good order after this time; 0: no limit. For machines on loan, not for results",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.epochs < 1:
            raise SettingError("rise_epochs + hold_epochs + decay_epochs: must come to at least one epoch")

    @property
    def epochs(self) -> int:
        """Length of the whole schedule."""
        return round(self.rise_epochs + self.hold_epochs + self.decay_epochs)


def learning_rate(epoch: float, settings: TrainingSettings) -> float:
    """Linear rise, polynomial decay (the paper's LRPD) at a fractional epoch counted from 0."""
    start, peak, end = settings.learning_rate_start, settings.learning_rate_peak, settings.learning_rate_end
    if epoch < settings.rise_epochs:
        return start + (peak - start) * epoch / settings.rise_epochs
    decayed = epoch - settings.rise_epochs - settings.hold_epochs
    if decayed <= 0.0:
        return peak
    if decayed >= settings.decay_epochs:
        return end
    return end + (peak - end) * (1.0 - decayed / settings.decay_epochs) ** settings.decay_power
