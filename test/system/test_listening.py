"""What the processes of a cell listen on: 127.0.0.1 only, unless the user asks for more."""

from __future__ import annotations

import http.client
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from ipaddress import ip_address

import psutil
import pytest

from helpers.executor_cell import Stalls
from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.nodes.base.network import own_domain


@dataclass(frozen=True)
class Socket:
    """One bound socket."""

    pid: int
    is_udp: bool
    is_loopback: bool
    """Whether only this machine reaches it."""
    port: int


def is_loopback(text: str) -> bool:
    address = ip_address(text)
    return (getattr(address, "ipv4_mapped", None) or address).is_loopback


def sockets_of(pid: int) -> list[Socket]:
    """Every Internet socket that a process has open; [] where it has ended."""
    try:
        found = psutil.Process(pid).net_connections("inet")
    except psutil.Error:
        return []
    return [Socket(pid, one.type == socket.SOCK_DGRAM, is_loopback(one.laddr.ip), one.laddr.port) for one in found if one.laddr]


_PORTS = {"grpc_port": 19876, "web_port": 19090}
_START_WITHIN = 120.0


@contextmanager
def viewer(**environ: str) -> Iterator[subprocess.Popen[str]]:
    """viewer_node with the environment of a user who has set nothing but `environ`."""
    arguments = [part for name, port in _PORTS.items() for part in ("-p", f"{name}:={port}")]
    names = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE")
    given = {name: value for name, value in os.environ.items() if name not in names}
    node = subprocess.Popen(
        [sys.executable, "-m", "push_ident.nodes", "viewer_node", "--ros-args", *arguments],
        env=given | {"ROS_DOMAIN_ID": str(own_domain())} | environ,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield node
    finally:
        node.send_signal(signal.SIGINT)
        node.communicate(timeout=30.0)


def sockets_below(pid: int, *, n_participants: int = 1) -> list[Socket]:
    """Sockets of a process and of all that it has started, once those of the viewer and of each participant are among them."""
    deadline = time.monotonic() + _START_WITHIN
    while True:
        processes = (pid, *(child.pid for child in psutil.Process(pid).children(recursive=True)))
        found = [one for process in processes for one in sockets_of(process)]
        if set(_PORTS.values()) <= {s.port for s in found} and len({s.pid for s in found if s.is_udp}) >= n_participants:
            return found
        assert time.monotonic() < deadline, found
        time.sleep(0.2)


@pytest.mark.alone
@pytest.mark.long
def test_every_process_of_a_cell_listens_on_loopback_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(own_domain()))
    commands = node_commands("sim", view=True, parameters={"viewer_node": dict(_PORTS)})
    with Supervisor(commands):
        sockets_below(os.getpid(), n_participants=len(commands))
        time.sleep(1.0)
        found = sockets_below(os.getpid(), n_participants=len(commands))
    assert [s for s in found if not s.is_loopback] == []


@pytest.mark.live
def test_the_network_is_opened_by_the_discovery_range() -> None:
    with viewer(ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET") as node:
        found = sockets_below(node.pid)
    assert any(not s.is_loopback for s in found if s.is_udp), "the test cannot see an open socket"
    assert all(s.is_loopback for s in found if not s.is_udp), "the range of ROS does not open the viewer"


@pytest.mark.alone
def test_viewer_listens_on_loopback_leads_from_its_plain_address_to_the_data_and_ends_with_its_node() -> None:
    with viewer() as node:
        found = sockets_below(node.pid)
        assert {s.is_udp for s in found} == {True, False} and [s for s in found if not s.is_loopback] == []
        servers = {s.pid for s in found if s.port in _PORTS.values()} - {node.pid}
        assert len(servers) == 1

        def get(path: str, **headers: str) -> tuple[int, str, bytes]:
            with closing(http.client.HTTPConnection("127.0.0.1", _PORTS["web_port"], timeout=10.0)) as page:
                page.request("GET", path, headers=headers)
                answer = page.getresponse()
                return answer.status, answer.getheader("Location") or "", answer.read()

        status, there, _ = get("/", Host="localhost:19090")
        assert (status, there) == (302, "/?url=rerun%2Bhttp%3A%2F%2Flocalhost%3A19876%2Fproxy")
        status, _, content = get(there)
        assert status == 200 and b"<html" in content and b"rerun" in content.lower()
        # What the browser loads then comes from the same port; nothing of a strange host is repeated.
        assert get("/re_viewer_bg.wasm")[0] == 200
        assert get("/", Host="evil/x")[1] == "/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A19876%2Fproxy"

        with Stalls() as stalls:
            node.kill()
            killed = time.monotonic()
            while any(sockets_of(pid) for pid in servers):
                assert time.monotonic() - killed < 2.0 + 4.0 * stalls.worst, "the server outlives its node"
                time.sleep(0.02)
