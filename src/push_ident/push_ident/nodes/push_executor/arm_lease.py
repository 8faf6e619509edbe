"""One executor per arm: a lease that the kernel gives to one process and takes back when that process ends, however it ends."""

from __future__ import annotations

import errno
import hashlib
import socket
import struct

from push_ident.errors import InputError

__all__ = ["ArmLease"]


class ArmLease:
    """The right to command the arm that listens on a topic of a ROS domain.

    It is the name of an abstract Unix socket: binding it is atomic, so of two processes that start at once one wins, and the name is
    free again as soon as its holder is gone, even by SIGKILL. Such names are shared by all processes of one network namespace, where
    ROS nodes of one machine find each other. An executor on another machine is found in the ROS graph instead (`ArmPort.rivals`).
    """

    def __init__(self, domain_id: int, topic: str) -> None:
        """Take the lease; raises InputError, naming the process that holds it, when it is taken.

        `topic` is the resolved name of the topic that commands the arm.
        """
        name = "\0push_ident_arm_" + hashlib.sha256(f"{domain_id} {topic}".encode()).hexdigest()[:32]
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(name)
        except OSError as error:
            self._socket.close()
            if error.errno != errno.EADDRINUSE:
                raise InputError(f"The lease of the arm on {topic} cannot be taken: {error.strerror}.") from None
            raise InputError(
                f"Another executor ({_holder(name)}) commands the arm on {topic} in ROS domain {domain_id}; stop it first."
            ) from None
        self._socket.listen()

    def release(self) -> None:
        """Give the arm free; the end of the process does so, too."""
        self._socket.close()


def _holder(name: str) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.2)
        try:
            probe.connect(name)
        except OSError:
            return "process unknown"
        pid, _, _ = struct.unpack("3i", probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
    return f"process {pid}"
