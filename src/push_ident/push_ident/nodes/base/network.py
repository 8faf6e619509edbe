"""Which network the processes of this package listen on: the loopback interface of this machine unless the user asks for more.

ROS 2 has the variable ROS_AUTOMATIC_DISCOVERY_RANGE for that, but its value LOCALHOST limits discovery only: Fast DDS still binds sockets
to every interface. So the range LOCALHOST, which is the default here, becomes a profile of Fast DDS that binds each socket to 127.0.0.1,
together with the range SYSTEM_DEFAULT, which leaves the profile as it is.
"""

from __future__ import annotations

import random
import socket
from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

from push_ident.errors import InputError

RANGE: Final = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PROFILE: Final = "FASTRTPS_DEFAULT_PROFILES_FILE"
COMMAND_LINE: Final = "/push_ident/command_line"
"""Enclave of SROS 2 of the nodes of the command line (`security/policy.xml`)."""
_LOCAL: Final = "fastdds_local.xml"
_NETWORK: Final = "fastdds_network.xml"
_LAST_DOMAIN: Final = 101
"""The highest ROS domain whose ports are free on every Linux: https://docs.ros.org/en/jazzy/Concepts/Intermediate/About-Domain-ID.html"""
_HELD: Final[dict[int, socket.socket]] = {}
"""What holds each domain of this process, the one that was given out longest ago first; the kernel closes them when it ends."""


def choose_network(environ: MutableMapping[str, str]) -> None:
    """Complete the variables that the middleware reads when a node is created. A profile that the user has set is kept.

    Without ROS_AUTOMATIC_DISCOVERY_RANGE, or with LOCALHOST, everything listens on 127.0.0.1 only; with SUBNET on every interface.
    """
    known = environ.get(RANGE, "").upper()
    profile = environ.get(PROFILE, "")
    is_ours = not profile or Path(profile).name in (_LOCAL, _NETWORK)
    if "fastrtps" not in environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") or not is_ours:
        environ.setdefault(RANGE, "LOCALHOST")
    elif known in ("", "LOCALHOST", "OFF") or (known == "SYSTEM_DEFAULT" and Path(profile).name != _NETWORK):
        environ[PROFILE] = str(Path(__file__).with_name(_LOCAL))
        environ[RANGE] = "OFF" if known == "OFF" else "SYSTEM_DEFAULT"
    else:
        environ[PROFILE] = str(Path(__file__).with_name(_NETWORK))


def listens_on(environ: MutableMapping[str, str]) -> str:
    """For people: what `choose_network` has chosen."""
    if Path(environ.get(PROFILE, "")).name == _LOCAL:
        return "this machine only (127.0.0.1)"
    if environ.get(RANGE, "").upper() == "LOCALHOST":
        return "this machine only for discovery (LOCALHOST); the profile or the middleware decides about sockets"
    return f"every interface ({RANGE}={environ.get(RANGE, 'not set')})"


def own_domain() -> int:
    """A ROS domain that no other process that asked for one has, until this process ends.

    An abstract socket holds it: as domains do, its name belongs to the network of the machine or of the container, and leaves no file.
    Where no other is left it is the one that this process was given longest ago: its cell is over. Raises InputError: others hold all.
    """
    for domain in random.SystemRandom().sample(range(1, _LAST_DOMAIN + 1), _LAST_DOMAIN):
        holder = socket.socket(socket.AF_UNIX)
        try:
            holder.bind(f"\0push_ident/ros_domain/{domain}")
        except OSError:
            holder.close()
            continue
        _HELD[domain] = holder
        return domain
    if _HELD:
        domain = next(iter(_HELD))
        _HELD[domain] = _HELD.pop(domain)
        return domain
    raise InputError(f"other cells of this machine hold all ROS domains from 1 to {_LAST_DOMAIN}; stop one, or set ROS_DOMAIN_ID")
