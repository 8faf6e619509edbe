"""The page of the live view: its plain address shows the cell.

The viewer of Rerun shows its own welcome page unless the address says where the data is. This server stands in front of it: the plain
address leads to the one with the data, everything else comes from Rerun.
"""

from __future__ import annotations

import http.client
import re
import shutil
import socket
import threading
from contextlib import closing
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from urllib.parse import parse_qs, quote, urlsplit

from push_ident.nodes.viewer.settings import VIEWER

__all__ = ["PageServer"]

_HOST: Final = re.compile(r"(?P<host>[A-Za-z0-9.\-]{1,253}|\[[0-9A-Fa-f:.]{2,45}\])(?::\d{1,5})?")
"""Host and port as a browser asks for them; of anything else nothing is repeated in the answer."""
_PASSED_ON: Final = ("Content-Type", "Content-Length", "Content-Encoding", "Last-Modified", "ETag", "Cache-Control")


class PageServer:
    """Serves the page until it is closed, in threads of its own.

    Args:
        bind: Address of the interface to listen on.
        port: Of the page.
        inner: Host and port at which Rerun serves its viewer.
        grpc_port: Of the data, at the host that the browser asks for.

    Raises:
        OSError: `port` of `bind` cannot be used.
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
