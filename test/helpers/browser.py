"""A real Chromium without a screen, driven over its DevTools protocol: pages at any width, in the dark, and printed."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

ANSWER = 60.0
"""Longest wait for an answer of the browser [s]; a loaded machine is slow."""


def installed() -> str:
    """The browser: `PUSH_IDENT_CHROMIUM`, else one on the path; the test is skipped where there is none."""
    found = os.environ.get("PUSH_IDENT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("Chromium is not installed; install it, or name it in PUSH_IDENT_CHROMIUM")
    return found


class Tab:
    """One page of the browser."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._numbers, self._session = socket, itertools.count(1), None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Page.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        """One command and its result; events in between are left unread."""
        number = next(self._numbers)
        session = {} if self._session is None else {"sessionId": self._session}
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters, **session}))
        while True:
            answer = json.loads(self._socket.recv(timeout=ANSWER))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def show(self, page: Path, width: int, *, dark: bool = False) -> None:
        """Load a page in a window of this width [CSS px]."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        scheme = "dark" if dark else "light"
        self.call("Emulation.setEmulatedMedia", media="", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self.call("Page.navigate", url=page.as_uri())
        self.value("new Promise(done => document.readyState === 'complete' ? done(1) : addEventListener('load', () => done(1)))")

    def value(self, expression: str) -> Any:
        """What an expression of JavaScript gives in the page."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def picture(self) -> bytes:
        """The whole page as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)["data"])

    def printed_pages(self) -> int:
        """Number of A4 pages of the print."""
        pdf = base64.b64decode(self.call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69, printBackground=False)["data"])
        return len(re.findall(rb"/Type\s*/Page\b", pdf))


@contextlib.contextmanager
def tab(scratch: Path) -> Iterator[Tab]:
    """A browser with one page, its profile in `scratch`."""
    options = ["--headless=shell", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-port=0"]
    command = [installed(), *options, f"--user-data-dir={scratch / 'profile'}", "about:blank"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        assert process.stderr is not None
        address = next((found[1] for line in process.stderr if (found := re.search(r"DevTools listening on (ws://\S+)", line))), None)
        assert address is not None, "the browser did not start"
        with connect(address, max_size=2**27, open_timeout=ANSWER) as socket:
            yield Tab(socket)
    finally:
        process.kill()
        process.wait()
