"""Recordings as a LeRobot data set, for imitation learning: one episode a recording, of all its arms.

Written from LeRobot's format v3.0 (`lerobot/datasets/utils.py`, `lerobot_dataset.py` of release 0.4.4), with
images inside the Parquet files, its `dtype: image`; as JPEG, since PNG takes 0.5 instead of 0.1 MB an image
and saves less than a sensor's own noise. A frame is an image and what was known at its exposure; its action
is the command that followed. Names of numbers end in their unit.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_base.topics import IMAGE
from tactile_perception.estimating.image import in_color
from tactile_records.bags.contents import Bag, Recorded
from tactile_records.bags.message_columns import stamps_ns
from tactile_records.bags.reader import read_bag
from tactile_records.replay.images import COMPRESSED, image_of
from tactile_records.runs.euler_poses import euler_poses, inverses
from tactile_records.runs.export import EULER, TANGENT, TWIST, pose_columns
from tactile_records.runs.from_bag import arms_of, run_from_bag
from tactile_records.runs.record import RunRecord
from tactile_wire.cdr import layout_of
from tactile_wire.errors import MessageError

Array = NDArray[Any]

VERSION, PER_CHUNK = "v3.0", 1000
AT_ONCE, IMAGES_FOR_STATISTICS, JPEG_QUALITY = 64, 100, 95
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
STATE, CONTACT, ACTION, PICTURE = "observation.state", "observation.contact", "action", "observation.images."
COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@dataclass
class Episode:
    """One recording, frame by frame.

    Attributes
    ----------
    numbers : feature -> (names, values (N, len(names)))
    images : arm -> the message of each frame (N), and the bag that says how to read it
    repeated : frames that show an image again since none came in time
    """

    task: str
    fps: int
    numbers: dict[str, tuple[list[str], Array]]
    bag: Bag
    images: dict[str, list[Recorded]]
    repeated: int
    shown: dict[str, Array] = field(default_factory=dict)  # the last picture of each arm

    def __len__(self) -> int:
        return len(next(iter(self.images.values())))

    def pictures(self, arm: str, start: int, end: int) -> Iterator[Array]:
        """Images (H, W, 3) uint8 of an arm, blue, green and red.

        In the place of one that cannot be decoded stands the one before it.
        """
        for message in self.images[arm][start:end]:
            found = image_of(self.bag.typestore(message.type).fielddefs, message, color=True)
            if found.pixels is not None:
                self.shown[arm] = in_color(found.pixels)
            else:
                what = f"{message.topic} at {found.stamp_ns} ns: {found.fault}"
                if arm not in self.shown:
                    raise ValueError(f"{self.bag.folder}: {what}")
                self.bag.problems.append(f"{what}; the image before it is in its place")
            yield self.shown[arm]


def episode_of(folder: Path, fps: int | None = None) -> Episode:
    """A recording as an episode, at a rate of frames or at its camera's.

    `BagError` or `ValueError` if it has no run, or an arm of it no images.
    """
    bag = read_bag(folder)
    records = {arm: run_from_bag(bag, arm) for arm in arms_of(bag)}
    records = {arm: record for arm, record in records.items() if len(record.pose)}
    streams = {arm: stream for arm in records if (stream := _stream(bag, arm)) is not None}
    if not streams:
        raise ValueError(f"{folder}: no arm with poses and images: record them with --record-images")
    fps = fps or max(1, round(SECOND_NS / float(np.median(np.diff(next(iter(streams.values()))[0])))))
    period = SECOND_NS // fps
    spans = [stream[0] for stream in streams.values()] + [record.pose.stamp_ns for record in records.values()]
    first, last = max(ns[0] for ns in spans), min(ns[-1] for ns in spans)
    times = first + np.arange(max(0, (last - first) * fps // SECOND_NS + 1)) * SECOND_NS // fps
    if len(times) < 2:
        raise ValueError(f"{folder}: images and poses have {(last - first) / SECOND_NS:.2f} s in common")
    images, parts, repeated = {}, [], 0
    for arm, record in records.items():
        at = times
        if arm in streams:
            stamps, messages = streams[arm]
            nearest = _nearest(stamps, times)
            # what was known at the exposure itself, which is not quite the frame's time
            at = np.clip(stamps[nearest], times - period // 2, times + period // 2)
            images[arm] = [messages[k] for k in nearest]
            repeated += int(np.count_nonzero(np.diff(nearest) == 0))
        parts.append(_numbers(arm, record, at, period))
    numbers = {
        feature: ([n for p in parts for n in p[feature][0]], np.hstack([p[feature][1] for p in parts]))
        for feature in (STATE, CONTACT, ACTION)
    }
    task = f"{record.task} in {record.scene or 'an unnamed scene'}"
    return Episode(task, fps, numbers, bag, images, repeated)


def _stream(bag: Bag, arm: str) -> tuple[Array, list[Recorded]] | None:
    """Exposure stamps (ns) and messages of an arm's images, in order; damaged ones are told and left out.

    None of an arm without images.
    """
    for topic in (IMAGE.of(arm).name, COMPRESSED.of(arm).name):
        found: list[tuple[int, int, Recorded]] = []
        for message in bag.messages:
            if message.topic == topic:
                try:
                    layout = layout_of(bag.typestore(message.type).fielddefs, message.type, message.data)
                except MessageError as error:
                    bag.problems.append(f"{topic}: an image is damaged: {error}")
                else:
                    stamp = stamps_ns(np.frombuffer(message.data, layout.dtype, 1), "header.stamp")
                    found.append((int(stamp[0]), len(found), message))
        if len(found) > 1:
            found.sort()
            return np.array([stamp for stamp, _, _ in found]), [message for _, _, message in found]
    return None


def _nearest(stamps: Array, times: Array) -> Array:
    """Index of the stamp next to each time."""
    after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    return np.asarray(after - (times - stamps[after - 1] < stamps[after] - times))


def _held(stamps: Array, times: Array) -> Array:
    """Index of the latest stamp up to each time, -1 before the first."""
    return np.asarray(np.searchsorted(stamps, times, side="right") - 1)


def _numbers(arm: str, record: RunRecord, times: Array, period: int) -> dict[str, tuple[list[str], Array]]:
    """State, believed contact and action of an arm at each time.

    Where there is no belief younger than two frames `believed` is 0, and so is the rest of the contact.
    """
    poses = record.pose.T_base_sensor[np.maximum(_held(record.pose.stamp_ns, times), 0)]
    state = pose_columns(f"{arm}_sensor", poses)
    belief, k = record.belief, _held(record.belief.stamp_ns, times)
    contact = np.zeros((len(times), 13))
    sigmas = [f"sigma_{name}_{'m' if name.startswith('rho') else 'rad'}" for name in TANGENT]
    names = [f"{arm}_{name}" for name in (*EULER, *sigmas, "believed")]
    if len(belief):
        known = (k >= 0) & (times - belief.stamp_ns[np.maximum(k, 0)] < 2 * period)
        contact[known, :6] = euler_poses(inverses(belief.mean[k[known]]))
        contact[known, 6:12] = np.sqrt(np.diagonal(belief.cov[k[known]], axis1=1, axis2=2))
        contact[known, 12] = 1.0
    # the first command within the frame's period, which its image gave rise to; else the one in force
    command, following = record.command, np.searchsorted(record.command.stamp_ns, times)
    action = np.zeros((len(times), 6))
    if len(command):
        soon = np.minimum(following, len(command) - 1)
        late = (following == len(command)) | (command.stamp_ns[soon] - times >= period)
        chosen = np.where(late, following - 1, soon)
        action[chosen >= 0] = command.twist[chosen[chosen >= 0]]
    return {
        STATE: (list(state), np.column_stack(list(state.values()))),
        CONTACT: (names, contact),
        ACTION: ([f"{arm}_{name}" for name in TWIST], action),
    }


def write_dataset(sources: Sequence[Path], folder: Path, fps: int | None = None) -> list[str]:
    """Write recordings as one data set into an empty folder; returns a line about each.

    Parameters
    ----------
    fps : int, optional
        Frames a second of all episodes; by default the camera's of the first.

    Raises
    ------
    ValueError
        A recording has no images, or others than the first: arms, sizes.
    """
    features: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    tasks: list[str] = []
    statistics: list[dict[str, dict[str, Array]]] = []
    remarks = []
    for source in sources:
        episode = episode_of(source, fps)
        fps = episode.fps
        own = _features(episode)
        features = features or own
        if own != features:
            raise ValueError(f"{source}: its arms or image sizes differ from those of {sources[0]}")
        if episode.task not in tasks:
            tasks.append(episode.task)
        number, begin = len(episodes), episodes[-1]["dataset_to_index"] if episodes else 0
        statistics.append(_write_episode(episode, folder, number, begin, tasks.index(episode.task)))
        row = {"episode_index": number, "tasks": [episode.task], "length": len(episode)}
        row |= {"data/chunk_index": number // PER_CHUNK, "data/file_index": number % PER_CHUNK}
        row |= {"dataset_from_index": begin, "dataset_to_index": begin + len(episode)}
        row |= {f"stats/{f}/{n}": v.tolist() for f, each in statistics[-1].items() for n, v in each.items()}
        episodes.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        remarks.append(f"{source}: {len(episode)} frames at {fps} Hz, {episode.task}")
        if episode.repeated:
            remarks.append(f"{source}: {episode.repeated} frames show an image again: none came in time")
        if episode.bag.problem:
            remarks.append(f"{source}: {episode.bag.problem}")
    _write_meta(folder, features, episodes, tasks, statistics, int(fps or 0))
    return remarks


def _features(episode: Episode) -> dict[str, Any]:
    """The data set's features as info.json names them."""
    features: dict[str, Any] = {}
    for arm in episode.images:
        shape = next(episode.pictures(arm, 0, 1)).shape
        features[PICTURE + arm] = {
            "dtype": "image", "shape": list(shape), "names": ["height", "width", "channels"]
        }  # fmt: skip
    for name, (names, _) in episode.numbers.items():
        features[name] = {"dtype": "float32", "shape": [len(names)], "names": names}
    for name in COUNTERS:
        dtype = "float32" if name == "timestamp" else "int64"
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    return features


def _write_episode(
    episode: Episode, folder: Path, number: int, begin: int, task: int
) -> dict[str, dict[str, Array]]:
    """Write the frames of one episode, a few at a time, since images are large; returns its statistics."""
    import pyarrow
    from pyarrow.parquet import ParquetWriter

    count = len(episode)
    frame = np.arange(count)
    counters: list[Array] = [frame / episode.fps, frame, np.full(count, number), begin + frame]
    values = {name: numbers for name, (_, numbers) in episode.numbers.items()}
    values |= dict(zip(COUNTERS, [*counters, np.full(count, task)], strict=True))
    path = folder / DATA.format(chunk_index=number // PER_CHUNK, file_index=number % PER_CHUNK)
    path.parent.mkdir(parents=True, exist_ok=True)
    samples: dict[str, list[Array]] = {arm: [] for arm in episode.images}
    every = -(-count // IMAGES_FOR_STATISTICS)
    writer = None
    for start in range(0, count, AT_ONCE):
        end = min(count, start + AT_ONCE)
        columns: dict[str, Any] = {}
        for arm in episode.images:
            pictures = list(episode.pictures(arm, start, end))
            samples[arm] += [picture[:, :, ::-1] / 255.0 for picture in pictures[-start % every :: every]]
            columns[PICTURE + arm] = _images(pictures)
        table = pyarrow.table(columns | {name: _column(each[start:end]) for name, each in values.items()})
        writer = writer or ParquetWriter(path, table.schema)
        writer.write_table(table)
    assert writer is not None
    writer.close()
    found = {PICTURE + arm: _picture_statistics(np.array(each)) for arm, each in samples.items()}
    return found | {name: _statistics(each.reshape(count, -1)) for name, each in values.items()}


def _images(pictures: list[Array]) -> Any:
    """A column of images, as LeRobot's readers take them."""
    import pyarrow

    packed = [cv2.imencode(".jpg", each, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1] for each in pictures]
    kind = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
    return pyarrow.array([{"bytes": each.tobytes(), "path": None} for each in packed], kind)


def _column(values: Array) -> Any:
    """A column of numbers (N,) or of vectors (N, M); float32 unless they are integers."""
    import pyarrow

    flat = pyarrow.array(values.ravel().astype(np.int64 if values.dtype.kind == "i" else np.float32))
    return flat if values.ndim == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _statistics(values: Array) -> dict[str, Array]:
    """Of the columns of values (N, M)."""
    found = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    found["count"] = np.array([len(values)])
    return found | {name: np.quantile(values, part, axis=0) for name, part in QUANTILES.items()}


def _picture_statistics(values: Array) -> dict[str, Array]:
    """Of images (N, H, W, 3) in 0 to 1, for each of the channels, (3, 1, 1)."""
    found = {name: v.reshape(-1, 1, 1) for name, v in _statistics(values.reshape(-1, 3)).items()}
    return found | {"count": np.array([len(values)])}


def _together(parts: list[dict[str, Array]]) -> dict[str, Any]:
    """Statistics of all episodes; quantiles are the mean of the episodes', as LeRobot has it."""
    counts = np.array([part["count"][0] for part in parts])
    shape = (-1, *[1] * parts[0]["mean"].ndim)
    weights = (counts / counts.sum()).reshape(shape)
    stacked = {name: np.array([part[name] for part in parts]) for name in parts[0]}
    mean = (weights * stacked["mean"]).sum(axis=0)
    variance = (weights * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(axis=0)
    found = {"min": stacked["min"].min(axis=0), "max": stacked["max"].max(axis=0), "mean": mean}
    found |= {"std": np.sqrt(variance), "count": np.array([counts.sum()])}
    found |= {name: (weights * stacked[name]).sum(axis=0) for name in QUANTILES}
    return {name: value.tolist() for name, value in found.items()}


def _write_meta(
    folder: Path,
    features: dict[str, Any],
    episodes: list[dict[str, Any]],
    tasks: list[str],
    statistics: list[dict[str, dict[str, Array]]],
    fps: int,
) -> None:
    """Write what is said of the whole: info.json last, so that a data set with it is complete."""
    import pyarrow
    import pyarrow.parquet

    (folder / EPISODES).parent.mkdir(parents=True)
    rows = {name: [row[name] for row in episodes] for name in episodes[0]}
    pyarrow.parquet.write_table(pyarrow.table(rows), folder / EPISODES)
    index = "__index_level_0__"
    table = pyarrow.table({"task_index": list(range(len(tasks))), index: tasks})
    # as pandas marks a column as the index: https://pandas.pydata.org/docs/development/developer.html
    told = {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object"}
    pandas = {"index_columns": [index], "column_indexes": [], "columns": [told | {"metadata": None}]}
    table = table.replace_schema_metadata({"pandas": json.dumps(pandas)})
    pyarrow.parquet.write_table(table, folder / "meta/tasks.parquet")
    stats = {name: _together([each[name] for each in statistics]) for name in features}
    (folder / "meta/stats.json").write_text(json.dumps(stats, indent=4))
    info = {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": episodes[-1]["dataset_to_index"],
        "total_tasks": len(tasks),
        "chunks_size": PER_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA,
        "video_path": None,
        "features": features,
    }
    (folder / "meta/info.json").write_text(json.dumps(info, indent=4))
