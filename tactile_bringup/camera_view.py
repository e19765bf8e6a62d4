"""What a camera sees, for `tactile camera`: pictures with figures, as lines and as a page in a browser."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.stamps import SECOND_NS
from tactile_perception.estimating.image import gray
from tactile_perception.markers.detection import DetectedMarkers, detect
from tactile_perception.markers.focus import blur
from tactile_perception.markers.view import draw_markers
from tactile_scene.camera import Camera, CameraFrame, CameraStatus, open_camera
from tactile_scene.scene import ArmScene

SHARP = 2.0  # px; markers of a TacTip have a radius of about six
STEADY = 0.02  # of the number of markers, by which it may vary
RATE_OFF = 0.05
PICTURES_A_SECOND = 10.0
PAGE = b"""<!doctype html><title>tactile camera</title>
<style>body{font:16px sans-serif;margin:2em;background:#222;color:#ddd}td{padding:0 1em 0 0}</style>
<img src="/stream" alt="no picture"><table id="figures"></table>
<script>
async function update() {
  const figures = await (await fetch("/figures")).json();
  const table = document.getElementById("figures");
  table.replaceChildren(...Object.entries(figures).map(([name, value]) => {
    const row = document.createElement("tr");
    for (const text of [name, value]) row.insertCell().textContent = text;
    return row;
  }));
}
setInterval(update, 500);
</script>
"""


@dataclass(frozen=True)
class Look:
    """One picture and what is found in it."""

    image: NDArray[np.uint8]
    markers: DetectedMarkers
    blur: float

    @property
    def figures(self) -> dict[str, str]:
        """Names and values, for people."""
        focus = "no markers" if math.isnan(self.blur) else f"{self.blur:.2f} px, sharp below {SHARP:g}"
        return {
            "markers": str(len(self.markers)),
            "blur of their edges": focus,
            "gray levels": f"{self.image.mean():.0f} on average, {self.image.std():.0f} apart",
            "size": f"{self.image.shape[1]}x{self.image.shape[0]}",
        }


def look(image: NDArray[np.uint8]) -> Look:
    """Find the markers of an image."""
    image = gray(image)
    markers = detect(image)
    return Look(image, markers, blur(image, markers))


class Watch:
    """An open camera and its newest frame."""

    def __init__(self) -> None:
        self.camera: Camera | None = None
        self.frames: list[tuple[int, int]] = []  # stamp, lost
        self._newest: CameraFrame | None = None
        self._came = threading.Condition()

    def take(self, frame: CameraFrame) -> None:
        """For the driver."""
        with self._came:
            self._newest = frame
            self.frames.append((frame.stamp_ns, frame.lost))
            del self.frames[:-1000]
            self._came.notify_all()

    @property
    def status(self) -> CameraStatus:
        """What the driver says of itself."""
        status: CameraStatus = getattr(self.camera, "status", CameraStatus())
        return status

    def next(self, timeout: float) -> NDArray[np.uint8]:
        """The next image; `OSError` with the driver's reason if none comes in this time (s)."""
        with self._came:
            if not self._came.wait(timeout) or self._newest is None:
                raise OSError(self.status.fault or f"the camera gives no image in {timeout:g} s")
            return self._newest.image


@contextmanager
def watching(arm: ArmScene) -> Iterator[Watch]:
    """The camera of an arm's sensor, open."""
    watch = Watch()
    watch.camera = open_camera(arm, watch.take)
    try:
        yield watch
    finally:
        watch.camera.close()


@dataclass(frozen=True)
class Verdict:
    """One line of a check."""

    good: bool
    text: str


def check(watch: Watch, rate: float, seconds: float, expected: int | None, sharp: float) -> list[Verdict]:
    """Look for so long (s): is the rate right, are the markers all there, and sharp?

    Raises `OSError` if no image comes.
    """
    watch.next(2.0)
    watch.frames.clear()
    looks: list[Look] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end or len(looks) < 3:
        looks.append(look(watch.next(2.0)))
    (first_ns, lost), (last_ns, lost_now), count = watch.frames[0], watch.frames[-1], len(watch.frames)
    found, missing = (count - 1) * SECOND_NS / max(1, last_ns - first_ns), lost_now - lost
    text = f"{found:.1f} frames a second, {rate:g} asked; {missing} of {count + missing} lost"
    return [Verdict(abs(found - rate) <= RATE_OFF * rate, text), *judged(looks, expected, sharp)]


def judged(looks: list[Look], expected: int | None, sharp: float) -> list[Verdict]:
    """Whether the markers are all there, and sharp; without a number `expected`, whether it is steady."""
    fewest, most = (limit(len(each.markers) for each in looks) for limit in (min, max))
    if expected is None:
        right = most > 0 and most - fewest <= STEADY * most
        wanted = "must be steady; --markers says how many"
    else:
        right, wanted = fewest == most == expected, f"must be {expected}"
    number = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    verdicts = [Verdict(right, f"{number} markers in {len(looks)} pictures; {wanted}")]
    blurs = [each.blur for each in looks if not math.isnan(each.blur)]
    if blurs:
        middle = float(np.median(blurs))
        focus = f"edges blurred by {middle:.2f} px, must be at most {sharp:g}"
        verdicts.append(Verdict(middle <= sharp, focus))
    return verdicts


def serve(watch: Watch, host: str, port: int) -> ThreadingHTTPServer:
    """A server of the page, which runs once `serve_forever` is called.

    Raises `OSError` if the port cannot be had.
    """
    try:
        server = ThreadingHTTPServer((host, port), type("Handler", (_Handler,), {"watch": watch}))
    except OSError as error:
        raise OSError(f"{host}:{port}: {error.strerror}; --port names another port") from error
    server.daemon_threads = True
    return server


class _Handler(BaseHTTPRequestHandler):
    watch: Watch

    def do_GET(self) -> None:
        answers = {"/": self._page, "/stream": self._stream, "/figures": self._figures}
        answer = answers.get(self.path)
        if answer is None:
            self.send_error(404, "there are /, /stream and /figures")
            return
        try:
            answer()
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True  # the browser has gone

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nobody wants a line for each picture."""

    def _page(self) -> None:
        self._send("text/html; charset=utf-8", PAGE)

    def _figures(self) -> None:
        status = self.watch.status
        figures = dict(status.values)
        if status.fault:
            figures["fault"] = status.fault
        for number, remark in enumerate(status.remarks, 1):
            figures[f"remark {number}"] = remark
        try:
            figures = look(self.watch.next(0.5)).figures | figures
        except OSError as error:
            figures["fault"] = str(error)
        self._send("application/json", json.dumps(figures).encode())

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
        self.end_headers()
        while True:
            try:
                data = self._jpeg()
            except OSError as error:
                if isinstance(error, ConnectionError):
                    raise
                continue  # nothing comes: /figures says why, and the browser may go on waiting
            head = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            self.wfile.write(head.encode() + data + b"\r\n")
            time.sleep(1.0 / PICTURES_A_SECOND)

    def _jpeg(self) -> bytes:
        seen = look(self.watch.next(2.0))
        return bytes(cv2.imencode(".jpg", draw_markers(seen.image, seen.markers))[1].tobytes())

    def _send(self, kind: str, data: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)
