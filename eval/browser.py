"""A headless Chromium that opens a page from disk, with no network and an empty profile."""

from __future__ import annotations

import base64
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["CHROMIUM", "DRIVER", "load", "open_browser", "resize", "screenshot", "severe"]

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
# WebGL on the processor: no graphics card is needed, and the figures are a lower bound.
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@contextmanager
def open_browser(width: int = 1400, height: int = 900) -> Iterator[Any]:
    """A selenium driver that ends with the block."""
    from selenium.webdriver import Chrome
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    options = Options()
    options.binary_location = CHROMIUM or ""
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for flag in (*_FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}"):
            options.add_argument(flag)
        driver = Chrome(options=options, service=Service(DRIVER))
        try:
            resize(driver, width, height)
            yield driver
        finally:
            driver.quit()


def load(driver: Any, page: Path) -> None:
    """Open a page of ``torchrecon report`` and wait until its numbers are unpacked.

    Raises:
        RuntimeError: the page failed to start; its own message.
    """
    driver.get(page.resolve().as_uri())
    waits = "const done = arguments[0]; torchrecon.ready.then(() => done(null), (error) => done(String(error)))"
    failed = driver.execute_async_script(waits)
    if failed is not None:
        raise RuntimeError(f"{page}: {failed}")


def resize(driver: Any, width: int, height: int, phone: bool = False, dark: bool = False) -> None:
    """Give the page another screen; a phone has two dots to a pixel and a touch screen's viewport rules."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 2 if phone else 1, "mobile": phone}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})


def screenshot(driver: Any, path: Path, width: int) -> None:
    """The whole page from top to bottom, not only what the window shows."""
    height = driver.execute_script("return document.documentElement.scrollHeight")
    clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
    taken = driver.execute_cdp_cmd("Page.captureScreenshot", {"captureBeyondViewport": True, "clip": clip})
    path.write_bytes(base64.b64decode(taken["data"]))


def severe(driver: Any) -> list[str]:
    """Errors in the console: of scripts, of the security policy, of files that were asked for."""
    return [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
