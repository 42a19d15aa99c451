"""A headless Chromium, controlled over two pipes: open a page, use its controls, read its image."""

import base64
import contextlib
import io
import itertools
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--remote-debugging-pipe",
)


def find() -> str | None:
    """The path of Chromium or Chrome; None if there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One tab. ``events`` are unsolicited messages of the browser."""

    def __init__(self, program: str, profile: Path, size: tuple[int, int]):
        get, give_back = os.pipe()
        get_back, give = os.pipe()
        options = [*_OPTIONS, f"--user-data-dir={profile}", "--window-size={},{}".format(*size)]
        # the browser reads requests from descriptor 3 and writes responses to descriptor 4
        line = f'exec "$0" "$@" 3<&{get} 4>&{give}'
        self.process = subprocess.Popen(
            ["bash", "-c", line, program, *options, "about:blank"],
            pass_fds=(get, give),
            stderr=subprocess.DEVNULL,
        )
        os.close(get)
        os.close(give)
        self._give, self._get, self._rest = give_back, get_back, b""
        self._numbers = itertools.count(1)
        self.events: list[dict] = []
        self._session = None
        tab = next(t for t in self.ask("Target.getTargets")["targetInfos"] if t["type"] == "page")
        joined = self.ask("Target.attachToTarget", targetId=tab["targetId"], flatten=True)
        self._session = joined["sessionId"]
        for domain in ("Page", "Runtime", "Network"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters) -> dict:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._give, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]
            self.events.append(answer)

    def _read(self) -> dict:
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._get], [], [], 120)
            part = os.read(self._get, 1 << 20) if ready else b""
            if not part:
                raise RuntimeError("the browser has gone or says nothing for two minutes")
            self._rest += part
        line, _, self._rest = self._rest.partition(b"\0")
        return json.loads(line)

    def run(self, script: str):
        """The value of an expression in the page; waits for a promise."""
        found = self.ask(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in found:
            raise RuntimeError(str(found["exceptionDetails"]))
        return found["result"].get("value")

    def open(self, address: str) -> None:
        self.events.clear()
        self.ask("Page.navigate", url="about:blank")
        self.ask("Page.navigate", url=address)
        self.wait(f"document.readyState === 'complete' && location.href === {address!r}")

    def wait(self, condition: str, seconds: float = 180.0) -> None:
        """Wait until the expression is true."""
        end = time.monotonic() + seconds
        while not self.run(condition):
            if time.monotonic() > end:
                raise TimeoutError(f"still not true after {seconds} s: {condition}")
            time.sleep(0.05)

    def look(self) -> np.ndarray:
        """Image of the page, (rows, columns, 3) from 0 to 1."""
        from matplotlib.image import imread

        twice = "new Promise(r => requestAnimationFrame(() => requestAnimationFrame(() => r(1))))"
        self.run(twice)  # wait until the frame is drawn
        picture = base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
        return imread(io.BytesIO(picture), format="png")[..., :3]

    def box(self, selector: str) -> tuple[slice, slice]:
        """Position of an element in the image: rows, columns."""
        place = f"document.querySelector({selector!r}).getBoundingClientRect().toJSON()"
        found = {name: round(value) for name, value in self.run(place).items()}
        return slice(found["top"], found["bottom"]), slice(found["left"], found["right"])

    @property
    def faults(self) -> list[str]:
        """Exceptions of the page's scripts since it was opened."""
        thrown = [e for e in self.events if e.get("method") == "Runtime.exceptionThrown"]
        return [json.dumps(event["params"]["exceptionDetails"]) for event in thrown]

    @property
    def requests(self) -> list[str]:
        """Addresses that the page requested since it was opened."""
        sent = [e for e in self.events if e.get("method") == "Network.requestWillBeSent"]
        return [event["params"]["request"]["url"] for event in sent]

    def close(self) -> None:
        with contextlib.suppress(OSError, RuntimeError):
            self._session = None
            self.ask("Browser.close")
        os.close(self._give)
        os.close(self._get)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@contextlib.contextmanager
def opened(program: str, profile: Path, size: tuple[int, int] = (720, 480)) -> Iterator[Browser]:
    """Context manager for a browser."""
    browser = Browser(program, profile, size)
    try:
        yield browser
    finally:
        browser.close()
