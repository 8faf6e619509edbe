"""What the executor decides on that is no parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class ExecutorSettings:
    """Times are wall time."""

    hold_margin: float = 0.03
    """By which a silent arm is given up early, so that it is held within `arm_timeout` [s]: three looks of the watch."""
    intake_grace: float = 0.03
    """For states that have arrived but were not taken in yet [s]."""
    rest_silence: float = 1.5
    """How long an arm at rest may stay silent before a push is refused [s]: one that was moved is believed after 1 s."""
    discovery: float = 5.0
    """The same for an arm without any state yet, and for a server of an action [s]: on a busy machine DDS needs seconds to find it."""
    standing_speed: float = 0.02
    """An arm whose joints are all slower stands [rad/s]."""
    n_joint_names: int = 256
    """Names of joints that are remembered."""
    max_joint_speed: float = 5.0
    """No joint turns faster [rad/s]: the fastest of an iiwa 7 reaches 3.1; descriptions often have a limit that is none."""
    hand_command_period: float = 0.2
    """Between two commands while the hand closes [s]: a driver may miss one, and activation comes before closing."""
    hand_speed: int = 128
    """Of closing, register rSPA of the manual [0..255]."""
    tool_period: float = 1.0 / 60.0
    """Shortest time between two messages of the tool's pose [s]."""
    answer_look: float = 0.05
    """Between two looks whether the server of an action has answered [s]."""
    answer_wait: float = 0.3
    """For the answer to a goal when the node is deactivated [s]."""


EXECUTOR: Final = ExecutorSettings()
