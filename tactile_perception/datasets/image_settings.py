"""How images of a data folder become inputs of a network: what its JSON files say, and what is assumed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from tactile_base.settings import SettingError
from tactile_perception.datasets import layout
from tactile_perception.datasets.layout import DatasetError, DatasetReport
from tactile_perception.datasets.suggestion import suggested
from tactile_perception.estimating.image import Image, ImageError, ImageKind
from tactile_perception.estimating.preprocessing import NO_THRESHOLD, PreprocessingSettings

#: Some camera images in color, or gray where they are, and whether there is one without contact.
Handful = Callable[[], tuple[list[Image], bool]]
_OF_LEVELS = "color", "median", "difference", "threshold_method", "threshold_block", "threshold_offset"


def image_settings(
    wanted: PreprocessingSettings | None, parameters: dict[str, Any], kind: ImageKind | None,
    handful: Handful | None, report: DatasetReport,
) -> PreprocessingSettings:  # fmt: skip
    """How images become inputs: as wanted, or as the folder states, for the size that most images have.

    Raises `DatasetError` if what the folder states is impossible, or camera images are of another size than
    wanted; the report says what was assumed.

    Parameters
    ----------
    wanted : the settings of a model, if there is one
    parameters : contents of the folder's JSON files, by name
    kind : of the images
    handful : some camera images; None where all are processed already
    """
    shape = kind.shape if kind else None
    if handful is None:
        if wanted is None:
            wanted = _preprocessing(parameters, report)
            if kind is not None and not kind.binary and wanted.binary:
                wanted = wanted.replaced(threshold_method=NO_THRESHOLD)
                report.notes.append("processed images are not black and white: taken as they are")
        else:
            _note_differences(wanted, parameters, report)
        return _suited(wanted, shape, report)
    if wanted is None:
        return _of_camera_images(parameters, handful, report)
    if shape is not None and shape not in (wanted.raw_shape, wanted.crop_shape):
        raise DatasetError(f"{report.folder}: {_other_size(shape, wanted)}")
    return wanted


def _other_size(shape: tuple[int, int], wanted: PreprocessingSettings) -> str:
    """That camera images are not of the size that a model takes, or that is usual where there is no model."""
    rows, columns = wanted.crop_shape
    return (
        f"camera images are {shape[1]}x{shape[0]}, not {wanted.raw_width}x{wanted.raw_height}: a model that "
        f"takes these (or their crop, {columns}x{rows}) refuses them; one trained on such images takes them"
    )


def _of_camera_images(
    parameters: dict[str, Any], handful: Handful, report: DatasetReport
) -> PreprocessingSettings:
    """What the folder states; for the rest, what suits its images."""
    name, stated = _stated(parameters, layout.IMAGE_PARAMS_NAMES + layout.CAMERA_PARAMS_NAMES, report)
    try:
        images, reference = handful()
        suggestion = suggested(images, reference)
    except ImageError as error:
        report.notes.append(f"what suits the images is not known: {error}")
        return _checked(stated, name, report)
    suits = asdict(suggestion.settings)
    if "bbox" in stated:
        del suits["circle_mask_radius"]
    if "threshold_method" in stated or "threshold_block" in stated:
        suits = {key: suits[key] for key in suits if key not in _OF_LEVELS}
    settings = _checked(suits | stated, name, report)
    shape = (images[0].shape[0], images[0].shape[1])
    if shape != PreprocessingSettings().raw_shape:
        report.notes.append(_other_size(shape, PreprocessingSettings()))
    report.notes.append(f"camera images: {'; '.join(suggestion.reasons)}. A network sees: {settings.steps}")
    return settings


def _preprocessing(parameters: dict[str, Any], report: DatasetReport) -> PreprocessingSettings:
    """Pre-processing settings of processed images, from the JSON file that holds them."""
    name, stated = _stated(parameters, layout.IMAGE_PARAMS_NAMES, report)
    if not name:
        report.notes.append(f"no {layout.IMAGE_PARAMS_NAME}: assumed the default crop and threshold")
    return _checked(stated, name, report)


def _checked(values: dict[str, Any], name: str, report: DatasetReport) -> PreprocessingSettings:
    try:
        return PreprocessingSettings.from_mapping(values, where=name)
    except SettingError as error:
        raise DatasetError(f"{report.folder}: {error}") from error


def _stated(
    parameters: dict[str, Any], names: tuple[str, ...], report: DatasetReport
) -> tuple[str, dict[str, Any]]:
    """The file that says how images become inputs, and what it says by our names; "" where there is none."""
    name = next((name for name in names if isinstance(parameters.get(name), dict)), "")
    params = parameters.get(name, {})
    kept = "bbox", "circle_mask_radius", "median", "threshold_method", "difference", "undistort"
    values = {key: params[key] for key in kept if params.get(key) is not None}
    if not any(values.get("bbox") or [1]):
        del values["bbox"]  # as some tools write that there is no crop
    if params.get("gray") is False:
        values |= {"color": True, "threshold_method": NO_THRESHOLD}
    if isinstance(params.get("dims"), list) and len(params["dims"]) == 2:
        values["raw_width"], values["raw_height"] = params["dims"]
    if params.get("thresh") is not None:
        block_and_offset = params["thresh"]
        if not isinstance(block_and_offset, list) or len(block_and_offset) != 2:
            raise DatasetError(
                f"{report.folder}: {name}: thresh = {block_and_offset!r}: must be a block and an offset"
            )
        values["threshold_block"], values["threshold_offset"] = block_and_offset
    return name, values


def _note_differences(
    wanted: PreprocessingSettings, parameters: dict[str, Any], report: DatasetReport
) -> None:
    """Say in which settings the images of a folder are not those that a model was trained on."""
    if any(name in parameters for name in layout.IMAGE_PARAMS_NAMES):
        stated = _preprocessing(parameters, report)
        stated = stated.replaced(size=wanted.size, redraw_radius=wanted.redraw_radius)
        if stated != wanted:
            report.notes.append(f"images pre-processed otherwise than wanted: {stated.differences(wanted)}")


def _suited(
    settings: PreprocessingSettings, shape: tuple[int, int] | None, report: DatasetReport
) -> PreprocessingSettings:
    """Settings for the size that most processed images have, where that is another than the settings say."""
    expected = settings.crop_shape
    if shape is None or shape == expected:
        return settings
    rows, columns = shape
    report.notes.append(
        f"processed images are {columns}x{rows}, not {expected[1]}x{expected[0]} as the settings say: "
        "taken as they are; the crop of the camera image is unknown"
    )
    return settings.replaced(
        bbox=(0, 0, columns, rows),
        raw_width=max(columns, settings.raw_width),
        raw_height=max(rows, settings.raw_height),
    )
