"""The server of a Rerun recording, as a separate process: the address to bind to is an option of its command line only."""

from __future__ import annotations

import ctypes
import http.client
import ipaddress
import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from contextlib import closing
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, quote, urlsplit

from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.nodes.viewer.settings import VIEWER

_HOST: Final = re.compile(r"(?P<host>[A-Za-z0-9.\-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\])(?::\d{1,5})?")
"""Host and port as a browser asks for them; of anything else nothing is repeated in the answer."""
_PASSED_ON: Final = ("Content-Type", "Content-Length", "Content-Encoding", "Last-Modified", "ETag", "Cache-Control")


class RerunServer:
    """Serves the data to viewers over gRPC, and a viewer for browsers over HTTP. It ends with the process that started it.

    Args:
        bind: Address of the interface to listen on; 127.0.0.1 serves this machine only.
        grpc_port: Of the data.
        web_port: Of the viewer for browsers.
        memory: Kept for viewers that come later, as `512MB`; the oldest goes first.

    Raises:
        InputError: `bind` is no address, or the server does not start there.
        ImportError: Rerun is not installed.
    """

    def __init__(self, *, bind: str, grpc_port: int, web_port: int, memory: str) -> None:
        import rerun_cli

        try:
            address = ipaddress.ip_address(bind)
        except ValueError:
            raise InputError(f"`bind` is {plain_text(bind)!r}, expected the address of an interface, as 127.0.0.1.") from None
        here = address if not address.is_unspecified else ipaddress.ip_address("127.0.0.1" if address.version == 4 else "::1")
        host = f"[{here}]" if here.version == 6 else str(here)
        self.url = f"rerun+http://{host}:{grpc_port}/proxy"
        """Where to send the data."""
        self.page = f"http://{host}:{web_port}"
        """What to open in a browser of this machine."""
        program = Path(rerun_cli.__file__).parent / "rerun"
        for port in (grpc_port, web_port):
            _check_free(bind, address.version, port)
        inner_port = _free_port(bind, address.version)
        ports = [f"--port={grpc_port}", f"--web-viewer-port={inner_port}"]
        self._process = _start([str(program), "--serve-web", f"--bind={bind}", *ports, f"--server-memory-limit={memory}"])
        self._front: PageServer | None = None
        try:
            for port in (grpc_port, inner_port):
                self._await_port(str(here), port)
            self._front = PageServer(bind=bind, port=web_port, inner=(str(here), inner_port), grpc_port=grpc_port)
        except BaseException:
            self.close()
            raise

    def _await_port(self, host: str, port: int) -> None:
        deadline = time.monotonic() + VIEWER.server_start
        while True:
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise InputError(f"The Rerun server does not listen on {host}, port {port}; check `memory` (as 512MB) and `bind`.")
            try:
                socket.create_connection((host, port), timeout=1.0).close()
                return
            except OSError:
                time.sleep(0.02)

    def close(self) -> None:
        """End the server."""
        if self._front is not None:
            self._front.close()
        self._process.terminate()
        try:
            self._process.wait(VIEWER.server_stop)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _check_free(bind: str, version: int, port: int) -> None:
    """Raise InputError where the port is in use: a connection would reach another process."""
    with socket.socket(socket.AF_INET if version == 4 else socket.AF_INET6) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((bind, port))
        except OSError as error:
            raise InputError(f"Port {port} of {bind} cannot be used: {error.strerror}; choose another `grpc_port` or `web_port`.") from None


def _free_port(bind: str, version: int) -> int:
    with socket.socket(socket.AF_INET if version == 4 else socket.AF_INET6) as probe:
        probe.bind((bind, 0))
        return int(probe.getsockname()[1])


def _start(command: list[str]) -> subprocess.Popen[bytes]:
    prctl, parent = ctypes.CDLL(None, use_errno=True).prctl, os.getpid()

    def end_with_parent() -> None:
        # PR_SET_PDEATHSIG of linux/prctl.h: sent when the thread ends that starts the process, the main thread of a node, which ends last.
        prctl(1, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(0)

    nowhere = subprocess.DEVNULL
    # A separate session: Ctrl-C ends the node, which still sends what it holds back, and then ends the server.
    return subprocess.Popen(command, stdin=nowhere, stdout=nowhere, stderr=nowhere, preexec_fn=end_with_parent, start_new_session=True)


class PageServer:
    """Serves the page until it is closed, in threads: its plain address shows the cell.

    The viewer of Rerun shows its own welcome page unless the address says where the data is. This server stands in front of it: the plain
    address leads to the one with the data, everything else comes from Rerun.

    Args:
        bind: Address of the interface to listen on.
        port: Of the page.
        inner: Host and port at which Rerun serves its viewer.
        grpc_port: Of the data, at the host that the browser asks for.

    Raises OSError: `port` of `bind` cannot be used.
    """

    def __init__(self, *, bind: str, port: int, inner: tuple[str, int], grpc_port: int) -> None:
        self._server = _Server((bind, port), inner, grpc_port)
        self._thread = threading.Thread(target=self._server.serve_forever, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], inner: tuple[str, int], grpc_port: int) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self.inner, self.grpc_port = inner, grpc_port
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away in the middle of an answer is no fault of the node."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        """See `http.server`."""
        asked = urlsplit(self.path)
        if asked.path in ("/", "/index.html") and "url" not in parse_qs(asked.query):
            self._lead_to_the_data()
        else:
            self._pass_on()

    do_HEAD = do_GET

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: requests are no news of the cell."""

    def _lead_to_the_data(self) -> None:
        named = _HOST.fullmatch(self.headers.get("Host", ""))
        host = named["host"] if named else "127.0.0.1"
        self.send_response(HTTPStatus.FOUND)
        self.send_header("Location", f"/?url={quote(f'rerun+http://{host}:{self.server.grpc_port}/proxy', safe='')}")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _pass_on(self) -> None:
        with closing(http.client.HTTPConnection(*self.server.inner, timeout=VIEWER.page_timeout)) as inner:
            try:
                inner.request(self.command, self.path)
                answer = inner.getresponse()
            except (OSError, http.client.HTTPException):
                self.send_error(HTTPStatus.BAD_GATEWAY, "the viewer does not answer")
                return
            self.send_response(answer.status)
            for name in _PASSED_ON:
                if (value := answer.getheader(name)) is not None:
                    self.send_header(name, value)
            self.send_header("Connection", "close")
            self.end_headers()
            if self.command == "GET":
                shutil.copyfileobj(answer, self.wfile)
