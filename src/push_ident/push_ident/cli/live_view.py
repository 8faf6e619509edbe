"""The live view of a command with `--view`: its address is printed, and opened in the browser where there is one."""

from __future__ import annotations

import http.client
import os
import sys
import threading
import time
import webbrowser
from contextlib import closing
from typing import Annotated, Final

import typer

from push_ident.cli.output import say, warn
from push_ident.nodes.viewer.settings import VIEWER

ViewOption = Annotated[bool, typer.Option("--view", help="Serve a live view for browsers, and open it.")]
ADDRESS: Final = f"http://localhost:{VIEWER.web_port}"


def show_view(wanted: bool) -> None:
    """Print and open the address of the live view as soon as it is served; returns at once."""
    if wanted:
        threading.Thread(target=_await_and_open, name="view", daemon=True).start()


def _await_and_open(patience: float = 60.0) -> None:
    deadline = time.monotonic() + patience
    while not _is_served():
        if time.monotonic() > deadline:
            warn(f"the live view is not served after {patience:.0f} s; see the log of viewer_node")
            return
        time.sleep(0.2)
    say(f"live view: {ADDRESS}")
    # Without a screen Python would start a browser for text in the terminal of the cell.
    if sys.platform == "darwin" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(ADDRESS)


def _is_served() -> bool:
    """Whether the page is there, and not another server on its port."""
    with closing(http.client.HTTPConnection("127.0.0.1", VIEWER.web_port, timeout=1.0)) as page:
        try:
            page.request("HEAD", "/")
            return (page.getresponse().getheader("Location") or "").startswith("/?url=rerun")
        except (OSError, http.client.HTTPException):
            return False
