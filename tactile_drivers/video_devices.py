"""Video devices of this computer (V4L2): which there are, what they offer, and why one cannot be opened."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

SYSTEM, DEVICES, BY_ID = Path("/sys/class/video4linux"), Path("/dev"), Path("/dev/v4l/by-id")

# linux/videodev2.h: requests, and the structures that they fill, with the places of what is read
_QUERY_CAPABILITIES = 0x80685600
_ENUMERATE_FORMATS, _ENUMERATE_SIZES, _ENUMERATE_INTERVALS = 0xC0405602, 0xC02C564A, 0xC034564B
_CAPABILITIES_SIZE, _DEVICE_CAPABILITIES = 104, 88
_FORMAT = struct.Struct("<III32sI16x")  # index, type, flags, description, code
_SIZE = struct.Struct("<IIIII24x")  # index, format, type, width, height
_INTERVAL = struct.Struct("<IIIIIII24x")  # index, format, width, height, type, numerator, denominator
_CAPTURE, _DISCRETE = 1, 1
_MOST = 64  # entries of one list; drivers end theirs with EINVAL

Ioctl = Callable[[int, int, bytearray], int]


@dataclass(frozen=True)
class VideoFormat:
    """One format of one size, and the rates that it comes at (Hz, largest first)."""

    form: str
    width: int
    height: int
    rates: tuple[float, ...]

    def __str__(self) -> str:
        rates = "/".join(f"{rate:g}" for rate in self.rates)
        return f"{self.form} {self.width}x{self.height} at {rates or 'unknown'} Hz"


@dataclass(frozen=True)
class VideoDevice:
    """A device that gives images.

    Attributes
    ----------
    path : Path
        As /dev/video0; which number a device has changes when it is plugged in again.
    name : str
    lasting : Path
        A path by its serial number, which does not change; `path` where there is none.
    formats : tuple of VideoFormat
    fault : str
        Why it cannot be opened; empty if it can.
    """

    path: Path
    name: str
    lasting: Path
    formats: tuple[VideoFormat, ...] = ()
    fault: str = ""


def find_devices(
    system: Path = SYSTEM, devices: Path = DEVICES, by_id: Path = BY_ID, ioctl: Ioctl = fcntl.ioctl
) -> list[VideoDevice]:
    """The video devices that give images; those that only carry metadata of others are left out."""
    lasting = {os.path.realpath(link): link for link in sorted(by_id.glob("*"))}
    found = []
    for entry in sorted(system.glob("video*"), key=lambda item: (len(item.name), item.name)):
        path = devices / entry.name
        try:
            name = (entry / "name").read_text().strip()
        except OSError:
            name = "unknown"
        fault = objection(path, devices)
        formats: tuple[VideoFormat, ...] = ()
        if not fault:
            try:
                formats = formats_of(path, ioctl)
            except OSError as error:
                fault = f"{path}: {error.strerror}"
            else:
                if not formats:
                    continue
        found.append(VideoDevice(path, name, lasting.get(os.path.realpath(path), path), formats, fault))
    return found


def objection(path: Path, devices: Path = DEVICES) -> str:
    """Why a device cannot be opened, as far as that can be seen from outside; else empty."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        there = ", ".join(map(str, sorted(devices.glob("video*")))) or "none"
        return f"{path}: there is no such device; devices: {there}"
    except OSError as error:
        return f"{path}: {error.strerror}"
    if not stat.S_ISCHR(mode):
        return f"{path}: is no video device (a recording is played by the driver 'replay')"
    if not os.access(path, os.R_OK | os.W_OK):
        return f"{path}: no permission; type: sudo usermod -aG video $USER, and log in again"
    return ""


def holders(path: Path, processes: Path = Path("/proc")) -> list[str]:
    """Other programs that have the device open, as far as this user may see: "guvcview (4711)"."""
    device, found = os.path.realpath(path), []
    for process in processes.glob("[0-9]*"):
        try:
            held = any(os.path.realpath(link) == device for link in (process / "fd").iterdir())
            if held and process.name != str(os.getpid()):
                found.append(f"{(process / 'comm').read_text().strip()} ({process.name})")
        except OSError:  # of somebody else, or just ended
            continue
    return sorted(found)


def formats_of(path: Path, ioctl: Ioctl = fcntl.ioctl) -> tuple[VideoFormat, ...]:
    """What a device offers; empty for one that gives no images. Raises `OSError` if it cannot be asked."""
    handle = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        capabilities = bytearray(_CAPABILITIES_SIZE)
        ioctl(handle, _QUERY_CAPABILITIES, capabilities)
        if not struct.unpack_from("<I", capabilities, _DEVICE_CAPABILITIES)[0] & _CAPTURE:
            return ()
        return tuple(_formats(handle, ioctl))
    finally:
        os.close(handle)


def _formats(handle: int, ioctl: Ioctl) -> Iterator[VideoFormat]:
    for _, _, _, _, code in _entries(handle, ioctl, _ENUMERATE_FORMATS, _FORMAT, (_CAPTURE,)):
        form = struct.pack("<I", code).decode("ascii", "replace").strip()
        for _, _, kind, width, height in _entries(handle, ioctl, _ENUMERATE_SIZES, _SIZE, (code,)):
            if kind != _DISCRETE:
                continue  # any size within bounds, which cameras for this do not have
            intervals = _entries(handle, ioctl, _ENUMERATE_INTERVALS, _INTERVAL, (code, width, height))
            rates = {lower / upper for *_, kind, upper, lower in intervals if kind == _DISCRETE and upper}
            yield VideoFormat(form, width, height, tuple(sorted(rates, reverse=True)))


def _entries(
    handle: int, ioctl: Ioctl, request: int, layout: struct.Struct, chosen: tuple[int, ...]
) -> Iterator[tuple]:
    """The entries of a list of the device, of which `chosen` says what it is asked for."""
    for index in range(_MOST):
        data = bytearray(layout.size)
        struct.pack_into(f"<{1 + len(chosen)}I", data, 0, index, *chosen)
        try:
            ioctl(handle, request, data)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):  # the end of the list, or there is none
                return
            raise
        yield layout.unpack(data)
