"""Settings of network, training and augmentation; defaults are the paper's GDN, where it gives a value."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tactile_base.settings import LARGEST_SEED, SettingError, Settings, setting

HEADS = ("mse", "gaussian", "full_gaussian", "mixture")
FROZEN = ("nothing", "convolutions", "base")


@dataclass(frozen=True)
class NetworkSettings(Settings):
    """Convolutional base and head; the defaults are the paper's "Gaussian Density Networks"."""

    image_size: int = setting(128, unit="px", lower=16, upper=512, doc="side of the square input image")
    redraw_radius: float = setting(
        0.0,
        unit="px",
        lower=0.0,
        upper=50.0,
        doc="before it is reduced to this size, draw the image's markers again as discs of this radius in "
        "the crop, so that only their places count; 0: the image as it is",
    )
    first_stride: int = setting(
        1, lower=1, upper=4, doc="stride s of the first convolution, whose kernel is 3s x 3s; the paper's: 1"
    )
    channels: tuple[int, ...] = setting(
        (16, 32, 64, 128, 256), lower=1, upper=4096,
        doc="features of each block: convolution, batch norm, ReLU, max-pool",
    )  # fmt: skip
    unpooled_blocks: int = setting(
        0,
        lower=0,
        upper=10,
        doc="so many of the last blocks have no max-pool, which leaves a larger map; the paper's: 0",
    )
    field_order: int = setting(
        0,
        lower=0,
        upper=12,
        doc="the network first finds the markers' displacement field, in Zernike polynomials of this order; "
        "for rings of 331 markers, that are followed in the training images; 0: without, as the paper",
    )
    hidden: tuple[int, ...] = setting(
        (), lower=1, upper=65536,
        doc="features of each fully connected layer (SiLU) between blocks and outputs; the paper's: none",
    )  # fmt: skip
    batch_norm_momentum: float = setting(
        0.01, lower=1e-4, upper=1.0, doc="weight of a batch in the running statistics (0.01: Keras's default)"
    )
    head: str = setting(
        "gaussian",
        choices=HEADS,
        doc="mse: the paper's CNN; gaussian: its GDN; full_gaussian: correlated; mixture: two Gaussians",
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
    dropout_correlation: float = setting(
        0.05, lower=0.0, upper=0.99, doc="dropout of what full_gaussian and mixture add to these"
    )
    inverse_sigma_bounds: tuple[float, ...] = setting(
        (1e-6, 1e6), lower=1e-12, upper=1e12, length=2,
        doc="softbound of the inverse standard deviations (1/mm, 1/rad)",
    )  # fmt: skip
    mse_weights: tuple[float, ...] = setting(
        (1.0, 1.0, 1.0, 100.0, 100.0, 100.0),
        lower=0.0,
        upper=1e6,
        length=6,
        doc="weights of the components in the loss of the head mse (paper, eq. mse_loss_def)",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.channels:
            raise SettingError("channels = []: must name the features of one block at least")
        lower, upper = self.inverse_sigma_bounds
        if lower >= upper:
            raise SettingError(
                f"inverse_sigma_bounds = {self.inverse_sigma_bounds}: the first must be below the second"
            )

    @property
    def poolings(self) -> int:
        """Number of blocks that halve the image's side; the first always does."""
        return max(1, len(self.channels) - self.unpooled_blocks)

    @property
    def last_side(self) -> int:
        """Side of the last feature map; `SettingError` if the image cannot be divided so."""
        if self.image_size % self.first_stride:
            raise SettingError(
                f"image_size = {self.image_size}: must be a multiple of first_stride = {self.first_stride}"
            )
        side = self.image_size // self.first_stride // 2**self.poolings
        if side < 1:
            raise SettingError(
                f"{self.poolings} blocks halve an image of {self.image_size} pixels to nothing"
            )
        return side


@dataclass(frozen=True)
class TrainingSettings(Settings):
    """Optimizer, schedule and stopping of the paper; what concerns speed rather than result comes last."""

    model: str = setting(
        "surface",
        doc="contact model, what the network tells: surface, edge, surface_force or one of another package; "
        "what the data do not label has no part in the loss",
    )
    batch_size: int = setting(16, lower=1, upper=65536, doc="samples a step")
    learning_rate_start: float = setting(
        1e-5, lower=0.0, upper=1.0, doc="first learning rate of the linear rise"
    )
    learning_rate_peak: float = setting(1e-3, lower=0.0, upper=1.0, doc="learning rate after the rise")
    learning_rate_end: float = setting(
        1e-7, lower=0.0, upper=1.0, doc="learning rate at the end of the decay"
    )
    rise_epochs: float = setting(3.0, lower=0.0, upper=10000.0, doc="length of the linear rise")
    hold_epochs: float = setting(1.0, lower=0.0, upper=10000.0, doc="time at the peak")
    decay_epochs: float = setting(50.0, lower=0.0, upper=10000.0, doc="length of the decay")
    decay: str = setting(
        "polynomial", choices=("polynomial", "cosine"), doc="form of the decay; the paper's: polynomial"
    )
    decay_power: float = setting(
        0.5, lower=0.0, upper=10.0, doc="exponent of (1 - e / decay_epochs), if polynomial"
    )
    patience: int = setting(
        25, lower=1, upper=10000, doc="epochs without a better validation loss before stopping early"
    )
    choose: str = setting(
        "loss", choices=("loss", "last"),
        doc="which epoch's network is taken: that of the least validation loss, or the last one. With few "
        "contacts sigma gets too small long before errors grow: the loss shows it, and calibration mends it",
    )  # fmt: skip
    field_weight: float = setting(
        20.0, lower=0.0, upper=1e6, doc="weight of the markers' field in the loss, where the network finds it"
    )
    field_noise: float = setting(
        0.1,
        lower=0.0,
        upper=10.0,
        doc="the last layers also learn from the fields that were followed, with errors of this deviation, "
        "in parts of a field's own",
    )
    average_decay: float = setting(
        0.0,
        lower=0.0,
        upper=0.99999,
        doc="average the weights over steps: weight of the old average; 0: no averaging",
    )
    holdback: float = setting(
        0.0,
        lower=0.0,
        upper=0.5,
        doc="part of the training data kept out of training to calibrate the uncertainty on at the end",
    )
    fold: int = setting(
        0, lower=0, upper=99,
        doc="which part of that size is kept out; networks that leave out another each are joined by --folds",
    )  # fmt: skip
    start: str = setting(
        "",
        doc="folder of a finished run, as one on simulated images, to start from its network; '': random",
    )
    frozen: str = setting(
        "nothing", choices=FROZEN,
        doc="what stays as it was in the start: nothing; convolutions: normalization and head learn; "
        "base: only the head learns",
    )  # fmt: skip
    images_in_memory: float = setting(
        8.0, unit="GiB", lower=0.0, upper=1e5,
        doc="data in shards whose images need more are streamed, and validated and calibrated on a part",
    )  # fmt: skip
    least_steps: int = setting(
        0, lower=0, upper=10**7,
        doc="steps of the whole schedule at least: an epoch of few samples shows each of them several times",
    )  # fmt: skip
    seed: int = setting(
        0, lower=0, upper=LARGEST_SEED, doc="seed of weights, shuffling, dropout and augmentation"
    )
    precision: str = setting(
        "auto", choices=("auto", "fp32", "bf16"),
        doc="arithmetic of the convolutional base; auto: bf16 where the processor has it; others imitate it",
    )  # fmt: skip
    channels_last: bool = setting(True, doc="memory layout that CPU kernels prefer")
    threads: int = setting(0, lower=0, upper=1024, doc="CPU threads; 0: PyTorch's choice")
    max_minutes: float = setting(
        0.0,
        lower=0.0,
        upper=100000.0,
        doc="stop in good order after this time; 0: no limit. For machines on loan, not for results",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.epochs < 1:
            raise SettingError("rise_epochs + hold_epochs + decay_epochs: must come to at least one epoch")
        if self.frozen != FROZEN[0] and not self.start:
            raise SettingError(f"frozen = {self.frozen}: needs the network of another run to start from")

    @property
    def epochs(self) -> int:
        """Length of the whole schedule."""
        return round(self.rise_epochs + self.hold_epochs + self.decay_epochs)


@dataclass(frozen=True)
class AugmentationSettings(Settings):
    """Changes of the training images for which the right label is known; the defaults change nothing.

    Lengths are in pixels of the cropped image before it is resized.
    """

    symmetry: int = setting(
        1, lower=1, upper=360, doc="turn by a random multiple of 1/n of a circle; the TacTip's markers: 6"
    )
    mirror: bool = setting(
        False, doc="mirror every other image as well: markers in rings are the same in a mirror"
    )
    symmetry_center: tuple[float, ...] = setting(
        (), unit="px", lower=0.0, upper=8192.0,
        doc="x, y of the markers' center in the crop; []: found in the images",
    )  # fmt: skip
    symmetry_radius: float = setting(
        209.0, unit="px", lower=1.0, upper=8192.0,
        doc="only the disk of this radius turns, or of the largest in the crop; what is outside stays",
    )  # fmt: skip
    symmetry_sense: int = setting(
        1, choices=(-1, 1), doc="1: a turn from x to y in the image is one from x to y of the sensor"
    )
    symmetry_axis: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0, 0.0),
        lower=[-20.0] * 2 + [-0.5] * 2,
        upper=[20.0] * 2 + [0.5] * 2,
        length=4,
        unit="mm, rad",
        doc="axis of the symmetry in {s}: x, y and tilt about x, y; where training starts from",
    )
    symmetry_axis_rate: float = setting(
        3.0, lower=0.0, upper=1000.0,
        doc="learning rate of the axis (in mm and 1/50 rad) by that of the weights; 0: fixed",
    )  # fmt: skip
    shift: float = setting(0.0, unit="px", lower=0.0, upper=50.0, doc="standard deviation of a shift in x, y")
    turn: float = setting(0.0, unit="deg", lower=0.0, upper=10.0, doc="standard deviation of a small turn")
    marker_dropout: float = setting(
        0.0, lower=0.0, upper=0.5, doc="probability that a marker is painted over"
    )
    growth: float = setting(
        0.0,
        lower=0.0,
        upper=1.0,
        doc="probability that markers grow or shrink, as with brightness",
    )
    gain: float = setting(
        0.0, lower=0.0, upper=1.0,
        doc="standard deviation of the logarithm of a factor on brightness: for images without a threshold, "
        "whose levels are those of one day's light",
    )  # fmt: skip
    plain_epochs: float = setting(0.0, lower=0.0, upper=10000.0, doc="last epochs without any of this")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.symmetry_center) not in (0, 2):
            raise SettingError(f"symmetry_center = {self.symmetry_center}: must be [] or [x, y]")

    @property
    def copies(self) -> int:
        """Of an image by its symmetry, with itself: turned, and those mirrored."""
        return self.symmetry * (1 + self.mirror)

    @property
    def active(self) -> bool:
        """Whether any image is changed."""
        chances = (self.shift, self.turn, self.marker_dropout, self.growth, self.gain)
        return self.copies > 1 or any(chance > 0.0 for chance in chances)


def learning_rate(epoch: float, settings: TrainingSettings) -> float:
    """Linear rise, then decay (the paper's LRPD, if polynomial) at a fractional epoch counted from 0."""
    start, peak, end = settings.learning_rate_start, settings.learning_rate_peak, settings.learning_rate_end
    if epoch < settings.rise_epochs:
        return start + (peak - start) * epoch / settings.rise_epochs
    decayed = epoch - settings.rise_epochs - settings.hold_epochs
    if decayed <= 0.0:
        return peak
    if decayed >= settings.decay_epochs:
        return end
    left = 1.0 - decayed / settings.decay_epochs
    if settings.decay == "cosine":
        return end + (peak - end) * 0.5 * (1.0 - math.cos(math.pi * left))
    return end + (peak - end) * left**settings.decay_power
