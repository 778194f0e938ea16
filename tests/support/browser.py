"""A headless Chromium, controlled by WebDriver over HTTP, for tests of pages."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

DRIVER, BROWSER = shutil.which("chromedriver"), shutil.which("chromium")
MISSING = "" if DRIVER and BROWSER else "needs chromium and chromedriver"

_FLAGS = """--headless --no-sandbox --disable-gpu --disable-quic --no-first-run
--disable-background-networking --disable-component-update --disable-sync --hide-scrollbars
--force-device-scale-factor=1""".split()


class Page:
    """A session with one window, its console messages and its network requests."""

    def __init__(self, root: str, session: str) -> None:
        self.root = f"{root}/session/{session}"

    def call(self, command: str, **parameters: Any) -> Any:
        return _post(f"{self.root}/{command}", parameters)

    def open(self, file: Path, width: int = 1000, height: int = 800) -> None:
        self.call("window/rect", width=width, height=height)
        self.call("url", url=file.as_uri())

    def run(self, script: str, *arguments: Any) -> Any:
        return self.call("execute/sync", script=script, args=list(arguments))

    def data(self, name: str) -> str:
        """Return an entry of the page's data set."""
        return self.run("return document.documentElement.dataset[arguments[0]]", name)

    def keys(self, text: str) -> None:
        actions = [{"type": kind, "value": key} for key in text for kind in ("keyDown", "keyUp")]
        self.call("actions", actions=[{"type": "key", "id": "keys", "actions": actions}])

    def drag(self, start: tuple[int, int], end: tuple[int, int], kind: str = "mouse") -> None:
        moves = [
            {"type": "pointerMove", "duration": 0, "x": start[0], "y": start[1]},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerMove", "duration": 50, "x": end[0], "y": end[1]},
            {"type": "pointerUp", "button": 0},
        ]
        pointer = {"type": "pointer", "id": kind, "parameters": {"pointerType": kind}}
        self.call("actions", actions=[{**pointer, "actions": moves}])

    def media(self, **features: str) -> None:
        media_features = [{"name": n.replace("_", "-"), "value": v} for n, v in features.items()]
        self.cdp("Emulation.setEmulatedMedia", features=media_features)

    def cdp(self, command: str, **params: Any) -> Any:
        return self.call("goog/cdp/execute", cmd=command, params=params)

    def logged(self) -> list[str]:
        """Return console errors and warnings since the last call."""
        return [entry["message"] for entry in self.call("se/log", type="browser")]

    def requested(self) -> list[str]:
        """Return the addresses requested since the last call."""
        messages = [
            json.loads(e["message"])["message"] for e in self.call("se/log", type="performance")
        ]
        method = "Network.requestWillBeSent"
        return [m["params"]["request"]["url"] for m in messages if m["method"] == method]

    def picture(self) -> bytes:
        with urllib.request.urlopen(f"{self.root}/screenshot", timeout=30) as answer:
            return base64.b64decode(json.load(answer)["value"])

    def wait(self, script: str, seconds: float = 5.0) -> Any:
        """Return the first true value of the script."""
        last = time.monotonic() + seconds
        while not (value := self.run(script)):
            assert time.monotonic() < last, f"not within {seconds:g} s: {script}"
            time.sleep(0.02)
        return value


@contextmanager
def chromium(profile: Path) -> Iterator[Page]:
    """Open a window with its profile in the given folder."""
    assert DRIVER and BROWSER
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    driver = subprocess.Popen(
        [DRIVER, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    root = f"http://127.0.0.1:{port}"
    capabilities = {
        "browserName": "chrome",
        "goog:chromeOptions": {"binary": BROWSER, "args": [*_FLAGS, f"--user-data-dir={profile}"]},
        "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
    }
    try:
        for _ in range(100):
            try:
                session = _post(f"{root}/session", {"capabilities": {"alwaysMatch": capabilities}})
                break
            except ConnectionError:
                time.sleep(0.1)
            except urllib.error.URLError as fault:
                assert isinstance(fault.reason, ConnectionError), fault
                time.sleep(0.1)
        page = Page(root, session["sessionId"])
        yield page
        urllib.request.urlopen(urllib.request.Request(page.root, method="DELETE"), timeout=30)
    finally:
        driver.terminate()
        driver.wait(30)


def _post(address: str, data: Any) -> Any:
    request = urllib.request.Request(
        address, json.dumps(data).encode(), {"Content-Type": "application/json"}
    )
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]
    except urllib.error.HTTPError as fault:
        raise AssertionError(json.load(fault)["value"]["message"]) from None
