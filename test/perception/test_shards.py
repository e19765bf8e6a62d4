"""Data sets in shards: the same samples as the folders they come from, whole or refused, in any order."""

import shutil

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="shards need pyarrow (the extra 'parquet')")

from tactile_bringup.cli import main
from tactile_perception.datasets.dataset import DatasetError, open_folder, read_dataset
from tactile_perception.datasets.importing import import_folder
from tactile_perception.datasets.sharding import ShardSettings, write_shards
from tactile_perception.datasets.shards import ShardedFolder
from tactile_perception.datasets.writer import DatasetWriter, write_markers
from tactile_perception.estimating.preprocessing import PreprocessingSettings

COUNT = 23
SETTINGS = PreprocessingSettings().replaced(
    raw_width=64, raw_height=48, bbox=(2, 4, 62, 44), circle_mask_radius=0, threshold_method="none",
    difference=1.0, size=32,
)  # fmt: skip
SMALL = ShardSettings(group_rows=4, file_rows=10)


def camera_image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (48, 64), dtype=np.uint8)


def written(folder, seed: int, images: str = "processed", settings=SETTINGS, count: int = COUNT):
    """A data folder with forces, and the image without contact where images are compared with it."""
    rng = np.random.default_rng(seed)
    with DatasetWriter(folder, settings, images, extra=("Fx", "Fy", "Fz")) as writer:
        if settings.difference:
            writer.add_image(0, camera_image(7))
        for number in range(1, count + 1):
            force = dict(zip(("Fx", "Fy", "Fz"), rng.normal(size=3).tolist(), strict=True))
            writer.add(number, camera_image(1000 * seed + number), rng.normal(size=6), force)
        writer.finish()
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return written(tmp_path_factory.mktemp("data") / "one", 1)


@pytest.fixture
def shards(folder, tmp_path):
    write_shards([folder], tmp_path / "shards", SMALL)
    return tmp_path / "shards"


@pytest.mark.parametrize("images", ["processed", "raw"])
def test_samples_are_those_of_the_folder_in_another_order(images, tmp_path):
    source = written(tmp_path / "data", 1, images)
    write_shards([source], tmp_path / "shards", SMALL)
    ours, theirs = read_dataset(tmp_path / "shards"), read_dataset(source)
    assert len(list((tmp_path / "shards").iterdir())) == 2
    assert sorted(ours.names) == sorted(theirs.names) and ours.names != theirs.names
    order = [theirs.names.index(name) for name in ours.names]
    np.testing.assert_array_equal(ours.images, theirs.images[order])
    np.testing.assert_array_equal(ours.euler_mm_deg, theirs.euler_mm_deg[order])
    np.testing.assert_array_equal(ours.force, theirs.force[order])
    np.testing.assert_array_equal(ours.reference, theirs.reference)
    assert ours.preprocessing == theirs.preprocessing and ours.labelled == theirs.labelled


def test_the_hash_is_that_of_all_samples_and_not_of_a_part(folder, shards, tmp_path):
    opened = open_folder(shards)
    assert isinstance(opened, ShardedFolder) and read_dataset(shards).sha256 == opened.sha256
    assert read_dataset(shards, limit=10).sha256 != opened.sha256
    write_shards([written(tmp_path / "other", 2)], tmp_path / "others", SMALL)
    assert open_folder(tmp_path / "others").sha256 != opened.sha256


def test_writing_goes_on_where_it_was_interrupted_and_what_is_missing_is_told(folder, shards):
    first, second = sorted(shards.iterdir())
    contents = second.read_bytes()
    second.unlink()
    with pytest.raises(DatasetError, match=r"1 of 2 shards .* goes on where it was interrupted"):
        open_folder(shards)
    kept = first.stat().st_mtime_ns
    write_shards([folder], shards, SMALL)
    assert first.stat().st_mtime_ns == kept and second.read_bytes() == contents


def test_folders_are_merged_and_other_sets_added_each_with_its_own_sensors(folder, tmp_path):
    other = written(tmp_path / "other", 2)
    (other / "collect_params.json").write_text('{"robot": "sim", "sensors": 3}')
    write_shards([folder, other], tmp_path / "shards", SMALL)
    merged = open_folder(tmp_path / "shards")
    assert len(merged) == len(set(merged.names)) == 2 * COUNT
    assert set(merged.sensor[[name.startswith("0/") for name in merged.names]]) == {0}
    assert set(merged.sensor[[name.startswith("1/") for name in merged.names]]) == {1, 2, 3}
    write_shards([other], tmp_path / "shards", ShardSettings("more", 4, 10))
    more = open_folder(tmp_path / "shards")
    assert len(more) == len(set(more.names)) == 3 * COUNT
    assert len(set(more.sensor)) == 4 + 3
    assert len(read_dataset(tmp_path / "shards").images) == 3 * COUNT


def test_markers_go_along_where_they_are_known(folder, tmp_path):
    source = written(tmp_path / "data", 2)
    rng = np.random.default_rng(0)
    for number in range(1, COUNT + 1):
        write_markers(source, number, rng.uniform(0, 60, (5, 2)))
    write_shards([source], tmp_path / "shards", SMALL)
    ours, theirs = open_folder(tmp_path / "shards"), open_folder(source)
    for index, name in enumerate(ours.names):
        np.testing.assert_array_equal(ours.markers(index), theirs.markers(theirs.names.index(name)))
    write_shards([folder], tmp_path / "shards", ShardSettings("without", 4, 10))
    assert open_folder(tmp_path / "shards").markers(0) is None and open_folder(folder).markers(0) is None
    (source / "markers" / "image_1.npy").write_bytes(b"no array")
    with pytest.raises(DatasetError, match=r"image_1\.npy: cannot be read"):
        theirs.markers(theirs.names.index("image_1.png"))


def test_what_does_not_go_together_is_refused(folder, shards, tmp_path):
    other = written(tmp_path / "other", 2, settings=SETTINGS.replaced(difference=0.0))
    with pytest.raises(DatasetError, match="differ in preprocessing, reference"):
        write_shards([folder, other], tmp_path / "new", SMALL)
    with pytest.raises(DatasetError, match="is a shard of other data"):
        write_shards([written(tmp_path / "third", 3)], shards, SMALL)
    write_shards([other], tmp_path / "others", ShardSettings("other", 4, 10))
    for path in (tmp_path / "others").iterdir():
        shutil.copy(path, shards)
    with pytest.raises(DatasetError, match="has another preprocessing, reference than"):
        open_folder(shards)


def test_damaged_and_foreign_files_are_named(shards, tmp_path):
    import pyarrow
    from pyarrow import parquet

    path = min(shards.iterdir())
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1  # in an image
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=rf"{path.name}: is damaged"):
        read_dataset(shards)
    path.write_bytes(bytes(data[:100]))
    with pytest.raises(DatasetError, match=rf"{path.name}: is damaged, or no Parquet file"):
        open_folder(shards)
    (tmp_path / "foreign").mkdir()
    parquet.write_table(pyarrow.table({"a": [1]}), tmp_path / "foreign" / "a.parquet")
    with pytest.raises(DatasetError, match="is no shard of tactile data"):
        open_folder(tmp_path / "foreign")


def test_an_image_that_cannot_be_used_is_left_out_and_named(tmp_path):
    source = written(tmp_path / "data", 1)
    image = source / "processed_images" / "image_5.png"
    image.write_bytes(image.read_bytes()[:-20])
    lines = write_shards([source], tmp_path / "shards", SMALL)
    assert any("unusable image: 1" in line and "image_5.png" in line for line in lines)
    assert len(open_folder(tmp_path / "shards")) == COUNT - 1


def test_the_command_shards_parts_and_other_commands_read_them(tmp_path, capsys):
    plain = SETTINGS.replaced(difference=0.0)
    for part, seed in (("train", 1), ("val", 2)):
        written(tmp_path / "data" / part, seed, settings=plain, count=40)
    out = tmp_path / "shards"
    assert main(["data", "shard", str(tmp_path / "data"), "--out", str(out), "--group", "8"]) == 0
    assert f"shards: {out / 'val'}" in capsys.readouterr().out.replace("\n", "")
    assert sorted(path.name for path in out.iterdir()) == ["train", "val"]
    assert main(["data", "check", str(out / "train")]) in (0, 1)
    assert "40 samples" in capsys.readouterr().out
    with pytest.raises(DatasetError, match="holds shards, which every command reads"):
        import_folder(out / "train", tmp_path / "imported")
