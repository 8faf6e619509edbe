"""Which network the processes listen on, by the variables that the user has set."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from push_ident.nodes.base.network import PROFILE, RANGE, choose_network, listens_on, own_domain, process_domain


def chosen(**environ: str) -> tuple[str, str]:
    """Range and name of the profile."""
    choose_network(environ)
    first = dict(environ)
    choose_network(environ)
    assert environ == first, "a child of the process would choose otherwise"
    assert PROFILE not in environ or Path(environ[PROFILE]).is_file() or environ[PROFILE] == "/own.xml"
    return environ.get(RANGE, ""), Path(environ.get(PROFILE, "")).name


@pytest.mark.parametrize("asked", [{}, {RANGE: "LOCALHOST"}, {RANGE: "localhost"}, {RANGE: "SYSTEM_DEFAULT"}])
def test_loopback_is_the_default(asked: dict[str, str]) -> None:
    assert chosen(**asked) == ("SYSTEM_DEFAULT", "fastdds_local.xml")
    choose_network(asked)
    assert "this machine only" in listens_on(asked)


def test_a_profile_of_an_earlier_set_up_is_replaced() -> None:
    assert chosen(**{PROFILE: "/gone/fastdds_local.xml", RANGE: "LOCALHOST"}) == ("SYSTEM_DEFAULT", "fastdds_local.xml")


def test_subnet_opens_every_interface_even_under_the_default_profile() -> None:
    environ = {RANGE: "SUBNET", PROFILE: "/somewhere/fastdds_local.xml"}
    assert chosen(**environ) == ("SUBNET", "fastdds_network.xml")
    choose_network(environ)
    assert "every interface" in listens_on(environ)


def test_off_stays_off() -> None:
    assert chosen(**{RANGE: "OFF"}) == ("OFF", "fastdds_local.xml")


def test_a_profile_of_the_user_is_kept() -> None:
    assert chosen(**{PROFILE: "/own.xml"}) == ("LOCALHOST", "own.xml")
    assert chosen(**{PROFILE: "/own.xml", RANGE: "SUBNET"}) == ("SUBNET", "own.xml")


def test_another_middleware_gets_the_range_of_ros() -> None:
    assert chosen(RMW_IMPLEMENTATION="rmw_cyclonedds_cpp") == ("LOCALHOST", "")


HOLD = "from push_ident.nodes.base.network import own_domain; print(own_domain(), flush=True); input()"


def test_a_domain_belongs_to_one_process_until_it_ends() -> None:
    others = [subprocess.Popen([sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    held = [int(process.stdout.readline()) for process in others if process.stdout]
    held += [own_domain(), process_domain(), own_domain()]
    assert len(set(held)) == 6 and all(1 <= domain <= 101 for domain in held)
    assert process_domain() == held[4]
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
