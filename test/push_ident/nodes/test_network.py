"""Which network the processes listen on, by the variables that the user has set."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from push_ident.nodes.base.network import PROFILE, RANGE, choose_network, listens_on, own_domain


@pytest.mark.parametrize(
    ("asked", "discovery", "profile"),
    [
        *(
            (asked, "SYSTEM_DEFAULT", "fastdds_local.xml")
            for asked in ({}, {RANGE: "LOCALHOST"}, {RANGE: "localhost"}, {RANGE: "SYSTEM_DEFAULT"})
        ),
        ({PROFILE: "/gone/fastdds_local.xml", RANGE: "LOCALHOST"}, "SYSTEM_DEFAULT", "fastdds_local.xml"),
        ({RANGE: "SUBNET", PROFILE: "/somewhere/fastdds_local.xml"}, "SUBNET", "fastdds_network.xml"),
        ({RANGE: "OFF"}, "OFF", "fastdds_local.xml"),
        ({PROFILE: "/own.xml"}, "LOCALHOST", "own.xml"),
        ({PROFILE: "/own.xml", RANGE: "SUBNET"}, "SUBNET", "own.xml"),
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, "LOCALHOST", ""),
    ],
)
def test_loopback_is_the_default_and_only_the_user_opens_more(asked: dict[str, str], discovery: str, profile: str) -> None:
    environ = dict(asked)
    choose_network(environ)
    first = dict(environ)
    choose_network(environ)
    assert environ == first, "a child of the process would choose otherwise"
    assert (environ.get(RANGE, ""), Path(environ.get(PROFILE, "")).name) == (discovery, profile)
    assert PROFILE not in environ or Path(environ[PROFILE]).is_file() or environ[PROFILE] == "/own.xml"
    if profile.startswith("fastdds") and discovery != "OFF":
        assert ("every interface" if discovery == "SUBNET" else "this machine only") in listens_on(environ)


HOLD = "from push_ident.nodes.base.network import own_domain; print(own_domain(), flush=True); input()"


def test_a_domain_belongs_to_one_process_until_it_ends() -> None:
    others = [subprocess.Popen([sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    held = [int(process.stdout.readline()) for process in others if process.stdout]
    held += [own_domain(), own_domain(), own_domain()]
    assert len(set(held)) == 6 and all(1 <= domain <= 101 for domain in held)
    for process in others:
        process.communicate("", timeout=20)
        assert process.returncode == 1  # end of file
