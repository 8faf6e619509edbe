"""What the live view decides on that is no parameter, and its default ports. No ROS, so that commands can name them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class ViewerSettings:
    """Ports, times and sizes on the screen."""

    web_port: int = 9090
    """Default of the page for browsers."""
    grpc_port: int = 9876
    """Default of the data."""
    max_age: float = 5.0
    """An object without a pose for this time is not drawn [s]."""
    jump_back: float = 1.0
    """Stamps this much older than the latest mean that time was set back [s]."""
    n_nodes: int = 200
    """Nodes whose status is shown."""
    default_height: float = 0.0
    """Height at which objects are drawn until the camera has measured their upper side [m]."""
    lift: float = 0.001
    """Distance in height between lines drawn on top of each other [m]."""
    line_width: float = 0.0012
    """[m]."""
    n_outlines: int = 6
    """Outlines that show a predicted motion."""
    shown: float = 0.25
    """Half the edge of the part of the table that the picture shows [m]."""
    steady: float = 0.1
    """By how much of its size the part of the picture that is shown may move before the camera counts as moving [-]."""
    flush_within: float = 1.0
    """For what is held back to reach a server or a file [s]; a node has 1.8 s to end."""
    server_start: float = 10.0
    """For the server to listen [s]; it takes 0.1 s on an idle machine."""
    server_stop: float = 0.5
    """From SIGTERM to SIGKILL of the server [s]."""
    page_timeout: float = 10.0
    """For an answer of the server to the page [s]."""


VIEWER: Final = ViewerSettings()
