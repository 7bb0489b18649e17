"""A headless Chromium that tests drive through its own protocol (DevTools), with nothing but
`websockets`.
"""

import base64
import json
import re
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any, Self

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--remote-debugging-port=0",
]
KEYS = {"Enter": ("Enter", 13, "\r"), " ": ("Space", 32, " "), "Escape": ("Escape", 27, "")} | {
    f"Arrow{name}": (f"Arrow{name}", code, "")
    for name, code in (("Left", 37), ("Up", 38), ("Right", 39), ("Down", 40))
}


class Browser:
    """One page.

    Args:
        profile: an empty folder. size: of the window, in pixels.
    """

    def __init__(self, profile: Path, size: tuple[int, int] = (1280, 900)) -> None:
        program = next(filter(None, map(shutil.which, NAMES)), None)
        if program is None:
            pytest.skip("no Chromium here: apt-get install chromium")
        sync = pytest.importorskip(
            "websockets.sync.client", reason="pip install websockets (the group dev has it)"
        )
        window = "--window-size={},{}".format(*size)
        command = [program, *FLAGS, window, f"--user-data-dir={profile}", "about:blank"]
        self._process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        self._socket: Any = None
        self._count = 0
        self.problems: list[str] = []
        """What the page's console says is wrong."""
        try:
            port = self._port()
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as response:
                page = next(target for target in json.load(response) if target["type"] == "page")
            self._socket = sync.connect(page["webSocketDebuggerUrl"], max_size=None, proxy=None)
            for domain in ("Page", "Runtime", "Log"):
                self.call(f"{domain}.enable")
            self.call(
                "Emulation.setDeviceMetricsOverride",
                width=size[0],
                height=size[1],
                deviceScaleFactor=1,
                mobile=False,
            )
        except BaseException:
            self.close()
            raise

    def _port(self) -> int:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if match := re.search(r"DevTools listening on ws://[^:]+:(\d+)/", line):
                return int(match[1])
        raise RuntimeError("Chromium ended without saying where it listens")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("method") == "Runtime.exceptionThrown":
                self.problems.append(str(message["params"]["exceptionDetails"]))
            if (
                message.get("method") == "Log.entryAdded"
                and message["params"]["entry"]["level"] == "error"
            ):
                self.problems.append(str(message["params"]["entry"]))
            if message.get("id") == self._count:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]

    def open(self, address: str) -> None:
        """Load a page."""
        self.call("Page.navigate", url=address)
        self.wait("document.readyState === 'complete'")

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression."""
        reply = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in reply:
            raise RuntimeError(f"{script}: {reply['exceptionDetails']}")
        return reply["result"].get("value")

    def wait(self, script: str, seconds: float = 60) -> None:
        """Wait until an expression is true, which may lead to another page meanwhile."""
        end = time.monotonic() + seconds
        while not self._is_true(script):
            if time.monotonic() > end:
                text = self.run("document.body.innerText")
                raise TimeoutError(
                    f"{script} did not come true in {seconds} s; the page"
                    f" says:\n{text}\n{self.problems}"
                )
            time.sleep(0.05)

    def _is_true(self, script: str) -> bool:
        try:
            return bool(self.run(script))
        except RuntimeError as error:
            if "navigated or closed" not in str(error):
                raise
            return False

    def text(self, selector: str) -> str:
        """What is to be read in an element, empty where it is hidden."""
        return self.run(f"document.querySelector({selector!r}).innerText")

    def press(self, key: str, shift: bool = False) -> None:
        """Press a key."""
        code, number, text = (
            KEYS[key] if key in KEYS else (f"Key{key.upper()}", ord(key.upper()), key)
        )
        event = {
            "key": key,
            "code": code,
            "windowsVirtualKeyCode": number,
            "modifiers": 8 if shift else 0,
        }
        self.call(
            "Input.dispatchKeyEvent", type="keyDown", **event, **({"text": text} if text else {})
        )
        self.call("Input.dispatchKeyEvent", type="keyUp", **event)

    def click(self, selector: str, place: tuple[float, float] = (0.5, 0.5)) -> None:
        """Click into an element. place: (row, column) as parts of its height and width."""
        find = f"document.querySelector({selector!r})"
        self.run(f"{find}.scrollIntoView({{block: 'nearest'}})")
        x, y, width, height = self.run(
            f"(b => [b.x, b.y, b.width, b.height])({find}.getBoundingClientRect())"
        )
        at = {
            "x": x + place[1] * width,
            "y": y + place[0] * height,
            "button": "left",
            "clickCount": 1,
        }
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, **at)

    def screenshot(self) -> bytes:
        """The visible part of the page as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        """End the browser."""
        if self._socket is not None:
            self._socket.close()
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stderr is not None:
            self._process.stderr.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
