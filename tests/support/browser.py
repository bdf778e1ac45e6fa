"""Headless Chromium that opens pages.

It is driven through the two pipes of ``--remote-debugging-pipe`` (Chrome DevTools Protocol, one
JSON object and a zero byte per message): no port, no package, and a page can be 400 pixels wide,
which a window cannot.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
EXECUTABLE = next(filter(None, map(shutil.which, NAMES)), None)
# The browser expects its pipes as descriptors 3 and 4, whatever they are called here.
LAUNCH = """import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
for number, end in enumerate(ends, 3): os.dup2(end, number)
os.execv(sys.argv[3], sys.argv[3:])"""
OPTIONS = (
    "--headless=new", "--no-sandbox", "--no-first-run", "--hide-scrollbars", "--mute-audio",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-dev-shm-usage", "--remote-debugging-pipe",
)  # fmt: skip
SECONDS = 60.0  # to wait for any answer
LOADED = "location.href != 'about:blank' && document.readyState == 'complete'"


class Browser:
    """A running browser; ``open`` gives pages. Without Chromium the test is skipped.

    Args:
        profile: an empty folder.
        options: more of Chromium's, such as "--use-angle=swiftshader" for WebGL.
    """

    def __init__(self, profile: Path, *options: str) -> None:
        if EXECUTABLE is None:
            pytest.skip("no Chromium on PATH")
        read_here, write_there = os.pipe()
        read_there, write_here = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-c", LAUNCH, str(read_there), str(write_there), EXECUTABLE,
             *OPTIONS, f"--user-data-dir={profile}", *options, "about:blank"],
            pass_fds=(read_there, write_there),
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(read_there)
        os.close(write_there)
        self._read, self._write, self._rest, self._count = read_here, write_here, b"", 0
        self.events: list[dict[str, Any]] = []

    def close(self) -> None:
        """End the browser."""
        try:
            with contextlib.suppress(TimeoutError, OSError):  # it may go without an answer
                self.ask("Browser.close")
            self._process.wait(SECONDS)
        finally:
            self._process.kill()
            os.close(self._read)
            os.close(self._write)

    def open(self, url: str | Path, width: int = 1280, height: int = 900, *, dark: bool = False,
             scripts: bool = True) -> Page:  # fmt: skip
        """Load a page and wait until it and all it asks for is there."""
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, session, target)
        for domain in ("Page", "Network", "Log", "Runtime"):
            page.ask(f"{domain}.enable")
        page.resize(width, height)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        page.ask("Emulation.setEmulatedMedia", features=[scheme])
        page.ask("Emulation.setScriptExecutionDisabled", value=not scripts)
        page.url = url.resolve().as_uri() if isinstance(url, Path) else url
        page.ask("Page.navigate", url=page.url)
        end = time.monotonic() + SECONDS
        # Not the load event, which may still be that of the empty page before.
        while not page.loaded:
            if time.monotonic() > end:
                raise TimeoutError(f"{page.url} does not load")
            time.sleep(0.01)
        return page

    def ask(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Send one command and return its result."""
        self._count += 1
        number = self._count
        message: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._write, data) :]
        answers: list[dict[str, Any]] = []
        self._until(lambda: bool(answers), number, answers)
        if "error" in answers[0]:
            raise RuntimeError(f"{method}: {answers[0]['error']['message']}")
        return answers[0]["result"]

    def _until(self, done: Any, number: int = 0, answers: list[Any] | None = None) -> None:
        end = time.monotonic() + SECONDS
        while not done():
            ready, _, _ = select.select([self._read], [], [], max(end - time.monotonic(), 0))
            data = os.read(self._read, 1 << 20) if ready else b""
            if not data:
                raise TimeoutError("the browser does not answer")
            *messages, self._rest = (self._rest + data).split(b"\0")
            for message in map(json.loads, messages):
                if "id" not in message:
                    self.events.append(message)
                elif message["id"] == number and answers is not None:
                    answers.append(message)


class Page:
    """A page in a browser."""

    url: str

    def __init__(self, browser: Browser, session: str, target: str) -> None:
        self._browser, self._session, self._target = browser, session, target

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send one command of the DevTools protocol to the page."""
        return self._browser.ask(method, self._session, **parameters)

    def happened(self, method: str) -> Iterator[dict[str, Any]]:
        """Yield the parameters of events of the page so far."""
        for event in self._browser.events:
            if event["method"] == method and event.get("sessionId") == self._session:
                yield event["params"]

    @property
    def requests(self) -> list[str]:
        """Addresses that the page tried, also in vain, but for itself and what is inside it."""
        urls = [event["request"]["url"] for event in self.happened("Network.requestWillBeSent")]
        return [url for url in urls if url != self.url and not url.startswith(("data:", "blob:"))]

    @property
    def complaints(self) -> list[str]:
        """What the browser complains of: errors of scripts, what the policy has blocked, ..."""
        logged = [e["entry"]["text"] for e in self.happened("Log.entryAdded")]
        thrown = [e["exceptionDetails"]["text"] for e in self.happened("Runtime.exceptionThrown")]
        return logged + thrown

    @property
    def loaded(self) -> bool:
        """Whether the page and all that it names is there."""
        try:
            return self.evaluate(LOADED)
        except RuntimeError:  # asked between two pages
            return False

    def resize(self, width: int, height: int = 900) -> None:
        """Give the page another size in CSS pixels."""
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height,
                 deviceScaleFactor=1, mobile=width < 600)  # fmt: skip

    def evaluate(self, script: str) -> Any:
        """Return the value of a JavaScript expression; of a promise, what it comes to."""
        answer = self.ask("Runtime.evaluate", expression=script, returnByValue=True,
                          awaitPromise=True)  # fmt: skip
        if "exceptionDetails" in answer:
            raise RuntimeError(answer["exceptionDetails"]["exception"]["description"])
        return answer["result"].get("value")

    @property
    def overflow(self) -> int:
        """Pixels that the content is wider than the page."""
        return self.evaluate(
            "document.documentElement.scrollWidth - document.documentElement.clientWidth"
        )

    def screenshot(self, path: Path, *, full: bool = True) -> None:
        """Write what the page shows as PNG: all of it, or what is in the window."""
        data = self.ask("Page.captureScreenshot", captureBeyondViewport=full)["data"]
        path.write_bytes(base64.b64decode(data))

    def close(self) -> None:
        """Close the page."""
        self._browser.ask("Target.closeTarget", targetId=self._target)
