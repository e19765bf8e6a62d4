#!/usr/bin/env python3
"""Draw the pictures of the page in the browser: `tactile view` on a recording and beside a running graph.

    . scripts/env.sh; scripts/draw_page.py BAG [--out docs/images]

BAG is a recording with images in which nothing was lost, as of `tactile demo --record-images --rate 20`.
Needs playwright, and chromium, which draws in software: beside it the graph runs at 20 Hz, too.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from playwright.sync_api import Error, sync_playwright

SIZE = {"width": 1400, "height": 850}
SOFTWARE = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
STARTS, HALF_DONE = 60.0, 120.0  # s, until an address is said, and until the task is half done
HALF = re.compile(r"follow, [456]\d %")


@contextlib.contextmanager
def served(*command: str) -> Iterator[str]:
    """The address of a page that a command of `tactile` serves."""
    with tempfile.NamedTemporaryFile("w+") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "tactile_bringup.cli", *command], stdout=output, stderr=output
        )
        end, found = time.monotonic() + STARTS, None
        while found is None and time.monotonic() < end and process.poll() is None:
            time.sleep(0.2)
            found = re.search(r"http://[\d.:]+", Path(output.name).read_text())
        if found is None:
            process.kill()
            sys.exit(Path(output.name).read_text())
        try:
            yield found[0]
        finally:
            process.terminate()
            process.wait()


def picture(browser: Any, address: str, tab: str, out: Path) -> None:
    """One picture of a page, with the task half done."""
    page = browser.new_page(viewport=SIZE)
    for attempt in range(20):
        try:
            page.goto(address)
            break
        except Error:  # it is said a few seconds before the page is there
            if attempt == 19:
                raise
            page.wait_for_timeout(1000)
    page.wait_for_selector("canvas")
    close = page.locator(".mantine-Notification-closeButton")  # that it is drawn in software
    while close.count():
        close.first.click()
        page.wait_for_timeout(300)
    page.get_by_role("tab", name=tab).click()
    page.wait_for_timeout(3000)  # for what the tab holds
    page.get_by_text(HALF).wait_for(timeout=1e3 * HALF_DONE)
    page.screenshot(path=out)
    page.close()
    print(out)


def main() -> None:
    """Both pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bag")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    given = parser.parse_args()
    path = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=SOFTWARE)
        with served("view", given.bag, "--port", "0") as address:
            picture(browser, address, "Touch", given.out / "view_recording.png")
        launch = ("launch", "surface_following", "--scene", "dome", "--headless", "--view", "--rate", "20")
        with tempfile.TemporaryDirectory() as folder, served(*launch, "--out", folder) as address:
            picture(browser, address, "Settings", given.out / "view_live.png")


if __name__ == "__main__":
    main()
