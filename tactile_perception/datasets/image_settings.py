"""How images of a data folder become inputs of a network: what its JSON files say, and what is assumed."""

from __future__ import annotations

from typing import Any

from tactile_base.settings import SettingError
from tactile_perception.datasets import layout
from tactile_perception.datasets.layout import DatasetError, DatasetReport
from tactile_perception.estimating.image import ImageKind
from tactile_perception.estimating.preprocessing import NO_THRESHOLD, PreprocessingSettings


def image_settings(
    wanted: PreprocessingSettings | None, parameters: dict[str, Any], kind: ImageKind | None,
    processed: bool, report: DatasetReport,
) -> PreprocessingSettings:  # fmt: skip
    """How images become inputs: as wanted, or as the folder states, for the size that most images have.

    Raises `DatasetError` if what the folder states is impossible, or camera images are of another size than
    wanted; the report says what was assumed.

    Parameters
    ----------
    wanted : the settings of a model, if there is one
    parameters : contents of the folder's JSON files, by name
    kind : of the images
    processed : whether they are cropped and thresholded already
    """
    shape = kind.shape if kind else None
    if wanted is None:
        return _suited(_preprocessing(parameters, processed, report), shape, processed, report)
    if processed:
        _note_differences(wanted, parameters, report)
        return _suited(wanted, shape, processed, report)
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


def _preprocessing(
    parameters: dict[str, Any], processed: bool, report: DatasetReport
) -> PreprocessingSettings:
    """Pre-processing settings of a folder from the JSON file that holds them."""
    names = layout.IMAGE_PARAMS_NAMES + (() if processed else layout.CAMERA_PARAMS_NAMES)
    name = next((name for name in names if isinstance(parameters.get(name), dict)), None)
    if name is None:
        report.notes.append(f"no {layout.IMAGE_PARAMS_NAME}: assumed the default crop and threshold")
        return PreprocessingSettings()
    params = parameters[name]
    values = {key: params[key] for key in ("bbox", "circle_mask_radius") if params.get(key) is not None}
    if params.get("gray") is False:
        values |= {"color": True, "threshold_method": NO_THRESHOLD}
    if not any(values.get("bbox") or [1]):
        del values["bbox"]  # as some tools write that there is no crop
    values |= {key: params[key] for key in ("median", "threshold_method", "difference") if key in params}
    if params.get("thresh") is not None:
        block_and_offset = params["thresh"]
        if not isinstance(block_and_offset, list) or len(block_and_offset) != 2:
            raise DatasetError(
                f"{report.folder}: {name}: thresh = {block_and_offset!r}: must be a block and an offset"
            )
        values["threshold_block"], values["threshold_offset"] = block_and_offset
    try:
        return PreprocessingSettings.from_mapping(values, where=name)
    except SettingError as error:
        raise DatasetError(f"{report.folder}: {error}") from error


def _note_differences(
    wanted: PreprocessingSettings, parameters: dict[str, Any], report: DatasetReport
) -> None:
    """Say in which settings the images of a folder are not those that a model was trained on."""
    if any(name in parameters for name in layout.IMAGE_PARAMS_NAMES):
        stated = _preprocessing(parameters, True, report)
        stated = stated.replaced(size=wanted.size, redraw_radius=wanted.redraw_radius)
        if stated != wanted:
            report.notes.append(f"images pre-processed otherwise than wanted: {stated.differences(wanted)}")


def _suited(
    settings: PreprocessingSettings, shape: tuple[int, int] | None, processed: bool, report: DatasetReport
) -> PreprocessingSettings:
    """Settings for the size that most images have, where that is another than the settings say."""
    expected = settings.crop_shape if processed else settings.raw_shape
    if shape is None or shape == expected:
        return settings
    rows, columns = shape
    if processed:
        report.notes.append(
            f"processed images are {columns}x{rows}, not {expected[1]}x{expected[0]} as the settings say: "
            "taken as they are; the crop of the camera image is unknown"
        )
    else:
        report.notes.append(f"{_other_size(shape, settings)}. Taken whole, without a mask")
    return settings.replaced(
        bbox=(0, 0, columns, rows),
        raw_width=columns if not processed else max(columns, settings.raw_width),
        raw_height=rows if not processed else max(rows, settings.raw_height),
        circle_mask_radius=settings.circle_mask_radius if processed else 0,
    )
