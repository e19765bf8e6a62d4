"""Video devices: what the system says of them, against a folder tree and answers of the kernel made here."""

import errno
import os
import struct

import pytest

from tactile_drivers.video_devices import VideoFormat, find_devices, formats_of, holders

# linux/videodev2.h; the structures were compared with the compiler's
QUERY_CAPABILITIES, FORMATS, SIZES, INTERVALS = 0x80685600, 0xC0405602, 0xC02C564A, 0xC034564B
CODES = {name: int.from_bytes(name.encode(), "little") for name in ("MJPG", "YUYV")}
OFFERED = [("MJPG", 640, 480, (30, 60)), ("MJPG", 1280, 720, (30,)), ("YUYV", 640, 480, (30,))]


def kernel(handle: int, request: int, data: bytearray, capture: bool = True) -> int:
    """Answers as V4L2 does, for a camera that offers `OFFERED`."""
    index = struct.unpack_from("<I", data)[0]
    if request == QUERY_CAPABILITIES:
        struct.pack_into("<I", data, 88, 0x04200001 if capture else 0x04A00000)
        return 0
    if request == FORMATS:
        entries = [(44, "<I", (code,)) for code in CODES.values()]
    elif request == SIZES:
        code = struct.unpack_from("<I", data, 4)[0]
        entries = [(8, "<III", (1, w, h)) for name, w, h, _ in OFFERED if CODES[name] == code]
    else:
        assert request == INTERVALS
        code, width, height = struct.unpack_from("<III", data, 4)
        chosen = [rates for name, w, h, rates in OFFERED if (CODES[name], w, h) == (code, width, height)]
        entries = [(16, "<III", (1, 1, rate)) for rate in chosen[0]]
    if index >= len(entries):
        raise OSError(errno.EINVAL, "Invalid argument")
    place, layout, values = entries[index]
    struct.pack_into(layout, data, place, *values)
    return 0


@pytest.fixture
def system(tmp_path):
    """/sys and /dev of a computer with these devices; other character devices stand for them."""

    def make(*names: str):
        folders = tmp_path / "sys", tmp_path / "dev", tmp_path / "dev" / "by-id"
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
        for number, (name, stand_in) in enumerate(zip(names, ("/dev/null", "/dev/zero"), strict=False)):
            (folders[0] / f"video{number}").mkdir()
            (folders[0] / f"video{number}" / "name").write_text(f"{name}\n")
            (folders[1] / f"video{number}").symlink_to(stand_in)
        return folders

    return make


def test_the_formats_of_a_device_are_listed_with_sizes_and_rates():
    assert formats_of("/dev/null", kernel) == (
        VideoFormat("MJPG", 640, 480, (60.0, 30.0)),
        VideoFormat("MJPG", 1280, 720, (30.0,)),
        VideoFormat("YUYV", 640, 480, (30.0,)),
    )
    assert str(formats_of("/dev/null", kernel)[0]) == "MJPG 640x480 at 60/30 Hz"


def test_a_device_that_carries_no_images_has_no_formats():
    assert formats_of("/dev/null", lambda *call: kernel(*call, capture=False)) == ()


def test_devices_are_found_with_name_and_the_path_that_lasts(system):
    folders = system("HD USB Camera", "Other Camera")
    (folders[2] / "usb-HD_USB_Camera-video-index0").symlink_to(folders[1] / "video0")
    found = find_devices(*folders, ioctl=kernel)
    assert [device.name for device in found] == ["HD USB Camera", "Other Camera"]
    assert [device.lasting.name for device in found] == ["usb-HD_USB_Camera-video-index0", "video1"]
    assert len(found[0].formats) == 3 and not found[0].fault


def test_a_device_that_may_not_be_opened_is_listed_with_what_to_type(system, monkeypatch):
    folders = system("HD USB Camera")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    (device,) = find_devices(*folders, ioctl=kernel)
    assert "no permission; type: sudo usermod -aG video" in device.fault and not device.formats


def test_a_device_that_fails_when_it_is_asked_is_listed_with_the_reason(system):
    def broken(*call):
        raise OSError(errno.EIO, "Input/output error")

    (device,) = find_devices(*system("HD USB Camera"), ioctl=broken)
    assert device.fault.endswith("video0: Input/output error")


def test_a_computer_without_a_camera_has_no_devices(tmp_path):
    assert find_devices(tmp_path / "sys", tmp_path / "dev", tmp_path / "dev") == []


def test_programs_that_hold_a_device_are_named(tmp_path):
    device = tmp_path / "video0"
    device.touch()
    for number, (name, file) in enumerate([("guvcview", device), ("bash", tmp_path / "other")], 4711):
        (tmp_path / "proc" / str(number) / "fd").mkdir(parents=True)
        (tmp_path / "proc" / str(number) / "fd" / "3").symlink_to(file)
        (tmp_path / "proc" / str(number) / "comm").write_text(f"{name}\n")
    assert holders(device, tmp_path / "proc") == ["guvcview (4711)"]
