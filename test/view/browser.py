"""A page of ours in a real browser: Debian's chromium, without a display, drawn in software."""

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

PATIENCE = 120.0  # s, on a machine that also draws the page, runs the arms, and other tests
SOFTWARE = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-dev-shm-usage",
)


@contextlib.contextmanager
def chromium() -> Iterator:
    """A browser, driven by playwright; the test is skipped, and says why, where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright (extra browser)")
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("needs chromium (Debian: apt install chromium)")
    with tempfile.TemporaryDirectory() as folder, playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=giving_way(path, folder), args=list(SOFTWARE))
        yield browser
        browser.close()


def giving_way(browser: str, folder: str) -> Path:
    """A command that starts the browser with less priority than the arms have.

    Playwright gives it a session of its own, which the kernel may give as much as the arms (autogroup); and
    started by root, its process that draws would take a higher priority.
    """
    command = Path(folder) / "browser"
    lasting = "setpriv --bounding-set=-sys_nice --inh-caps=-sys_nice" if os.geteuid() == 0 else ""
    command.write_text(
        "#!/bin/sh\n{ echo 10 >/proc/self/autogroup; } 2>/dev/null\n"
        f'exec nice -n 10 {lasting} {shlex.quote(browser)} "$@"\n'
    )
    command.chmod(0o755)
    return command


class Opened:
    """A page in the browser, of whoever serves it; it may be there a little after its address is said."""

    def __init__(self, browser, address: str) -> None:
        from playwright.sync_api import Error

        self.page = browser.new_page(viewport={"width": 1000, "height": 600})
        self.page.set_default_timeout(1e3 * PATIENCE)

        def there() -> bool:
            with contextlib.suppress(Error):
                return self.page.goto(address) is not None
            return False

        assert wait(there), address
        self.page.wait_for_selector("canvas")

    def text(self) -> str:
        return self.page.inner_text("body")

    def sees(self, text: str) -> bool:
        return wait(lambda: text in self.text())

    def picture(self) -> np.ndarray:
        """The scene (h, w, 3), uint8."""
        import cv2

        data = self.page.locator("canvas").first.screenshot()
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)

    def is_drawn(self) -> bool:
        """Whether the scene comes to show something."""
        return wait(lambda: len(np.unique(self.picture().reshape(-1, 3), axis=0)) > 100)

    def row(self, name: str):
        """What stands beside a name, its input among it."""
        return self.page.get_by_text(name, exact=True).locator("xpath=ancestor::*[.//input][1]").first

    def choose(self, name: str, option: str) -> None:
        """Another value of a list to choose from.

        As events, not at a place: the page grows while nodes are found, which moves what lies there.
        """
        label = self.page.locator("label", has_text=re.compile(f"^{re.escape(name)}$"))
        label.locator("xpath=ancestor::*[.//input][1]").locator("input").first.dispatch_event("click")
        self.page.get_by_role("option", name=option).dispatch_event("click")

    def images(self) -> str:
        """What the images of the page hold now."""
        return self.page.evaluate("[...document.querySelectorAll('img')].map(each => each.src).join()")

    def close(self) -> None:
        self.page.close()


class Viewer(Opened):
    """`tactile view` as a process, and a page of it."""

    def __init__(self, browser, folder: Path, *words: str, **variables: str) -> None:
        self.output = folder / "view.txt"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tactile_bringup.cli", "view", *words],
            env={**os.environ, **variables}, stdout=self.output.open("w"), stderr=subprocess.STDOUT,
        )  # fmt: skip
        assert wait(lambda: "open http" in self.said or self.process.poll() is not None), self.said
        found = re.search(r"http://[\d.]+:\d+", self.said)
        assert found, self.said
        self.address = found[0]
        super().__init__(browser, self.address)

    @property
    def said(self) -> str:
        return self.output.read_text()

    def close(self) -> None:
        super().close()
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(15.0)
            except subprocess.TimeoutExpired:
                self.process.kill()


def wait(holds: Callable[[], bool], seconds: float = PATIENCE) -> bool:
    end = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True
