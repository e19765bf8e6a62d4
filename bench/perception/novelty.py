"""Which measure tells images of other sensors and cameras from a sensor's own? On folders of images.

    python bench/perception/novelty.py TRAIN VALIDATION OTHER ... [--model RUN/model.onnx] [--images 400]

Where VALIDATION is TRAIN, every fifth image of it is held back as such. Each measure is fitted to images of
TRAIN, and its limit is 1.5 times what 99.5 % of others of them stay below. `pixels` is what model files have
of images that have been through a threshold (`Novelty`), `pixels and light` of others; `subspace` the part of
an image that is left over by the 128 main directions of the training images; `features` the Mahalanobis
distance of the last features of a network that was trained on TRAIN, in their 64 main directions. The rows
`validation, ...` are VALIDATION's images changed as a camera changes, and where they hold gray levels, its
light. A cell has the part that is refused, and the median over the limit.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).resolve().parents[1]))

from shared import Table, needs, parser, taken

from tactile_perception.estimating.novelty import Novelty
from tactile_perception.estimating.preprocessing import as_input

Images = NDArray[np.uint8]
Measure = Callable[[Images], NDArray[np.float64]]
DIRECTIONS, FEATURE_DIRECTIONS, MARGIN, RARE = 128, 64, 1.5, 0.995


def images_of(folder: Path, count: int) -> list[Images]:
    """Gray images that lie in a folder or below it, evenly picked; those of a camera as they are."""
    files = sorted(path for path in folder.rglob("*") if path.suffix in (".png", ".jpg"))
    if not files:
        raise SystemExit(f"{folder}: no images below it (.png or .jpg)")
    picked = np.linspace(0, len(files) - 1, min(count, len(files))).round().astype(int)
    return [cv2.imread(str(files[k]), cv2.IMREAD_GRAYSCALE) for k in picked]


def turned(degrees: float, pixels: float = 0.0) -> Callable[[Images], Images]:
    """A camera that is turned, then shifted to the right."""

    def change(image: Images) -> Images:
        rows, columns = image.shape
        matrix = cv2.getRotationMatrix2D((columns / 2, rows / 2), degrees, 1.0)
        matrix[0, 2] += pixels
        return cv2.warpAffine(image, matrix, (columns, rows), flags=cv2.INTER_NEAREST)

    return change


def glare(image: Images) -> Images:
    """A lamp's reflection, a seventh of the image wide."""
    rows, columns = image.shape
    return cv2.circle(image.copy(), (columns * 2 // 3, rows // 2), columns // 14, 255, thickness=-1)


def torn(image: Images) -> Images:
    """A twentieth of the markers gone."""
    _, labels, found, _ = cv2.connectedComponentsWithStats(image)
    gone = np.random.default_rng(0).random(len(found)) < 0.05
    return np.where(gone[labels], 0, image).astype(np.uint8)


def lit(gain: float, slope: float = 0.0) -> Callable[[Images], Images]:
    """Brighter or darker, to the right more than to the left by twice the slope."""

    def change(image: Images) -> Images:
        factors = gain + slope * np.linspace(-1.0, 1.0, image.shape[1])
        return np.clip(np.rint(image * factors), 0.0, 255.0).astype(np.uint8)

    return change


CAMERA: dict[str, Callable[[Images], Images]] = {
    "turned by 1 deg": turned(1.0),
    "turned by 2 deg": turned(2.0),
    "turned by 5 deg": turned(5.0),
    "shifted by 3 px": turned(0.0, 3.0),
    "shifted by 6 px": turned(0.0, 6.0),
    "blurred by 3 px": lambda image: cv2.GaussianBlur(image, (0, 0), 3.0),
    "a glare": glare,
    "mirrored": lambda image: np.ascontiguousarray(image[:, ::-1]),
}
MARKERS: dict[str, Callable[[Images], Images]] = {
    "markers larger by 1 px": lambda image: cv2.dilate(image, np.ones((3, 3), np.uint8)),
    "markers smaller by 1 px": lambda image: cv2.erode(image, np.ones((3, 3), np.uint8)),
    "a twentieth of the markers gone": torn,
}
LIGHT = {f"gain {gain:g}": lit(gain) for gain in (0.8, 0.9, 0.95, 1.05, 1.1, 1.25)} | {
    "darker to the left by 20 %, brighter to the right": lit(1.0, 0.2)
}


def pixels(train: Images, light: float = math.inf) -> Measure:
    """`Novelty`, whose limit is its own."""
    novelty = Novelty.fit(train, light)
    return lambda images: np.array([novelty(as_input(image)) for image in images])


def subspace(train: Images) -> Measure:
    """What is left over by the main directions, as a part of the deviation from the mean."""
    fit, held_out = (as_input(part).reshape(len(part), -1) for part in (train[::2], train[1::2]))
    mean = fit.mean(axis=0)
    axes = np.linalg.svd(fit - mean, full_matrices=False)[2][:DIRECTIONS]

    def measure(flat: NDArray) -> NDArray:
        deviation = flat - mean
        left = deviation - (deviation @ axes.T) @ axes
        return (left**2).sum(axis=1) / (deviation**2).sum(axis=1)

    limit = MARGIN * np.quantile(measure(held_out), RARE)
    return lambda images: measure(as_input(images).reshape(len(images), -1)) / limit


def features(train: Images, model: Path) -> Measure:
    """The distance of a network's features from those of the training images."""
    import onnx
    import onnxruntime

    graph = onnx.load(str(model))
    graph.graph.output.append(onnx.helper.make_tensor_value_info("features", onnx.TensorProto.FLOAT, None))
    session = onnxruntime.InferenceSession(graph.SerializeToString(), providers=["CPUExecutionProvider"])

    def of(images: Images) -> NDArray:
        parts = [session.run(["features"], {"image": as_input(image)})[0] for image in images]
        return np.concatenate(parts)

    fit, held_out = of(train[::2]), of(train[1::2])
    mean = fit.mean(axis=0)
    _, scales, axes = np.linalg.svd(fit - mean, full_matrices=False)
    axes, variances = axes[:FEATURE_DIRECTIONS], scales[:FEATURE_DIRECTIONS] ** 2 / len(fit)
    rest = float((scales[FEATURE_DIRECTIONS:] ** 2).sum() / len(fit) / fit.shape[1])

    def measure(found: NDArray) -> NDArray:
        deviation = found - mean
        parts = deviation @ axes.T
        left = (deviation**2).sum(axis=1) - (parts**2).sum(axis=1)
        return (parts**2 / variances).sum(axis=1) + left / rest

    limit = MARGIN * np.quantile(measure(held_out), RARE)
    return lambda images: measure(of(images)) / limit


def main() -> None:
    """See the module's text."""
    given = parser(__doc__ or "")
    given.add_argument("train", type=Path)
    given.add_argument("validation", type=Path)
    given.add_argument("others", nargs="*", type=Path)
    given.add_argument("--model", type=Path, help="trained on TRAIN")
    given.add_argument("--images", type=int, default=400, help="of each folder; ten times as many of TRAIN")
    given.add_argument("--size", type=int, default=64, help="side of what is compared (64)")
    arguments = given.parse_args()
    if arguments.model is not None:
        needs("scripts/setup.sh train", "onnx")
    side = arguments.size

    def shrunk(images: list[Images]) -> Images:
        return np.array([cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA) for image in images])

    order = np.random.default_rng(0).permutation(10 * arguments.images)
    read = images_of(arguments.train, 10 * arguments.images)
    if arguments.validation == arguments.train:
        own = read[::5]
        read = [image for k, image in enumerate(read) if k % 5]
    else:
        own = images_of(arguments.validation, arguments.images)
    train = shrunk([read[k] for k in order if k < len(read)])
    binary = set(np.unique(np.concatenate([image.ravel() for image in own[:20]]))) <= {0, 255}
    measures = {"pixels": pixels(train)} | ({} if binary else {"pixels and light": pixels(train, 0.0)})
    measures["subspace"] = subspace(train)
    if arguments.model is not None:
        measures["features"] = features(train, arguments.model)
    table = Table(["images", *measures], f"{len(train)} images of training, {len(own)} of each other folder")

    def row(name: str, images: list[Images]) -> None:
        found = [measure(shrunk(images)) for measure in measures.values()]
        table.row(name, *(f"{(each > 1.0).mean():.1%}, {np.median(each):.2f}" for each in found))

    row("validation", own)
    for name, change in (CAMERA | (MARKERS if binary else LIGHT)).items():
        row(f"validation, {name}", [np.asarray(change(image)) for image in own])
    for folder in arguments.others:
        row(
            folder.name if folder.name != "train" else folder.parent.name, images_of(folder, arguments.images)
        )
    for name, measure in measures.items():
        microseconds = np.median(taken(lambda _, measure=measure: measure(train[:1]), 500))
        print(f"\n{name}: {microseconds:.0f} us an image of {side}x{side}, its conversion to floats included")


if __name__ == "__main__":
    main()
