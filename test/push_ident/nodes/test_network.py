"""Which network the processes listen on, by the variables that the user has set."""

from __future__ import annotations

import json
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


HOLD_ALL = "from push_ident.nodes.base.network import own_domain; print([own_domain() for _ in range(300)][-202:], flush=True); input()"


def test_a_process_that_has_had_all_domains_gets_its_own_again_in_turn_and_others_get_none() -> None:
    """In a network of its own, so that no other process lacks one."""
    if subprocess.run(["unshare", "--user", "--net", "true"], capture_output=True, check=False).returncode != 0:
        pytest.skip("this user may not make a network namespace")
    program = (
        "import subprocess, sys\n"
        "from push_ident.errors import InputError\n"
        "from push_ident.nodes.base.network import own_domain\n"
        f"held = subprocess.Popen([sys.executable, '-c', {HOLD_ALL!r}], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)\n"
        "print(held.stdout.readline())\n"
        "try:\n    own_domain()\nexcept InputError as error:\n    print(error)\n"
        "held.communicate('')\n"
        "print(own_domain())\n"
    )
    done = subprocess.run(
        ["unshare", "--user", "--net", sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    given, refused, free = (line for line in done.stdout.splitlines() if line)
    first, second = json.loads(given)[:101], json.loads(given)[101:]
    assert first == second and sorted(first) == list(range(1, 102))
    assert "hold all ROS domains" in refused and 1 <= int(free) <= 101
