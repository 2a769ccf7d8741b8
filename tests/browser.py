"""A headless Chromium driven over WebDriver (W3C) with the standard library alone."""

from __future__ import annotations

import base64
import contextlib
import json
import shutil
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage", "--hide-scrollbars",
)  # fmt: skip


class Browser:
    """One browser window; errors of the page's scripts come as `RuntimeError`."""

    def __init__(self, address: str, profile: Path, flags: Sequence[str] = ()) -> None:
        options = {"binary": CHROMIUM, "args": [*FLAGS, f"--user-data-dir={profile}", *flags]}
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"}}
        self._address = address
        self._session = ""
        reply = self._ask("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self._session = f"/session/{reply['sessionId']}"

    def open(self, address: str, *, size: tuple[int, int] = (1200, 800), dark: bool = False) -> None:
        """Load a page at a size in CSS pixels, in a light or dark system."""
        self.cdp(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}],
        )
        self.cdp("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)
        self._ask("POST", "/url", {"url": "about:blank"})
        self.log("browser"), self.log("performance")
        self._ask("POST", "/url", {"url": address})

    def run(self, script: str, *arguments: Any) -> Any:
        """Run the body of a function in the page and return what it returns."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": list(arguments)})

    def run_async(self, script: str, *arguments: Any) -> Any:
        """The same for a body that calls its last argument with the result."""
        return self._ask("POST", "/execute/async", {"script": script, "args": list(arguments)})

    def wait(self, condition: str, seconds: float = 5.0) -> None:
        """Wait until an expression of the page is true."""
        end = time.monotonic() + seconds
        while not self.run(f"return Boolean({condition})"):
            if time.monotonic() > end:
                raise TimeoutError(condition)
            time.sleep(0.02)

    def cdp(self, command: str, **parameters: Any) -> Any:
        """Send a command of the Chrome DevTools Protocol."""
        return self._ask("POST", "/goog/cdp/execute", {"cmd": command, "params": parameters})

    def press(self, *keys: str) -> None:
        """Press and release keys, one after the other; special ones by their WebDriver code points."""
        strokes = [{"type": kind, "value": key} for key in keys for kind in ("keyDown", "keyUp")]
        self._act({"type": "key", "id": "keyboard", "actions": strokes})

    def mouse(self, *steps: tuple[float, float], click: bool = True) -> None:
        """Press the button at the first place of the window, drag it along the others and let go; or only move there."""
        moves = [{"type": "pointerMove", "x": round(x), "y": round(y), "duration": 20} for x, y in steps]
        down, up = ([{"type": f"pointer{what}", "button": 0}] if click else [] for what in ("Down", "Up"))
        actions = [moves[0], *down, *moves[1:], *up]
        self._act({"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": actions})

    def touch(self, *fingers: Sequence[tuple[float, float]]) -> None:
        """Put fingers down, each at its first place, move them along their ways together and lift them."""
        sources = []
        for k, way in enumerate(fingers):
            moves = [{"type": "pointerMove", "x": round(x), "y": round(y), "duration": 20} for x, y in way]
            actions = [moves[0], {"type": "pointerDown", "button": 0}, *moves[1:], {"type": "pointerUp", "button": 0}]
            sources.append(
                {"type": "pointer", "id": f"finger{k}", "parameters": {"pointerType": "touch"}, "actions": actions}
            )
        self._act(*sources)

    def wheel(self, x: float, y: float, delta: int) -> None:
        """Turn the wheel at a place."""
        action = {"type": "scroll", "x": round(x), "y": round(y), "deltaX": 0, "deltaY": delta, "origin": "viewport"}
        self._act({"type": "wheel", "id": "wheel", "actions": [action]})

    def log(self, kind: str) -> list[Any]:
        """What the browser logged since the last call: "browser" (console) or "performance" (network and more)."""
        return self._ask("POST", "/se/log", {"type": kind})

    def requests(self) -> list[str]:
        """Addresses that were asked for since the last call."""
        messages = [json.loads(entry["message"])["message"] for entry in self.log("performance")]
        return [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]

    def picture(self) -> bytes:
        """The window as a PNG."""
        return base64.b64decode(self._ask("GET", "/screenshot"))

    def quit(self) -> None:
        self._ask("DELETE", "")

    def _act(self, *sources: dict[str, Any]) -> None:
        self._ask("POST", "/actions", {"actions": list(sources)})
        self._ask("DELETE", "/actions")

    def _ask(self, method: str, path: str, body: Any = None) -> Any:
        data = json.dumps(body).encode() if body is not None else None
        request = urllib.request.Request(self._address + self._session + path, data=data, method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as reply:
                return json.load(reply)["value"]
        except urllib.error.HTTPError as error:
            raise RuntimeError(json.load(error)["value"]["message"]) from None


def opened(browser: Browser, page: Path, hash: str = "", **window: Any) -> None:
    """Open the page of a file."""
    browser.open(page.as_uri() + hash, **window)


@contextlib.contextmanager
def browsing(profile: Path, flags: Sequence[str] = ()) -> Iterator[Browser]:
    """A browser with a fresh profile, ended with the block."""
    assert DRIVER is not None
    driver = subprocess.Popen([DRIVER, "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert driver.stdout is not None
        line = next(text for text in driver.stdout if "started successfully on port" in text)
        port = int(line.split("port")[1].strip(" .\n"))
        browser = Browser(f"http://127.0.0.1:{port}", profile, flags)
        try:
            yield browser
        finally:
            browser.quit()
    finally:
        driver.terminate()
        driver.wait(10)
        if driver.stdout is not None:
            driver.stdout.close()
