"""Whether a Robotiq 3-finger hand is a closed fist, from the registers in its manual."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

CLOSED: Final = 255
"""Position of closed fingers; 0 is open."""
BASIC_MODE: Final = 0
"""Grasping mode in which three fingers close to a fist."""


class HandMotion(IntEnum):
    """Motion of the fingers (gSTA). Without an object they stop against each other, before or at the requested position."""

    MOVING = 0
    SOME_STOPPED = 1
    ALL_STOPPED = 2
    ARRIVED = 3


@dataclass(frozen=True, slots=True)
class HandState:
    """One status of the hand."""

    activated: bool
    mode: int
    """Grasping mode: 0 basic, 1 pinch, 2 wide, 3 scissor."""
    going: bool
    """Whether the hand moves to the requested position."""
    readiness: int
    """0 reset, 1 activating, 2 changing mode, 3 ready."""
    motion: int
    """A `HandMotion`."""
    fault: int
    """Fault code; 0: none."""
    request: int
    """Requested position, 0 open to 255 closed; a fist needs 240 at least."""

    @property
    def why_no_fist(self) -> str:
        """Why the hand is not a closed fist; empty when it is one."""
        if self.fault:
            return f"the hand reports fault 0x{self.fault:02X}; reset it"
        if not self.activated or self.readiness != 3:
            return "the hand is not activated; call close_hand"
        if self.mode != BASIC_MODE:
            return f"the hand is in grasping mode {self.mode}, expected basic mode ({BASIC_MODE}); call close_hand"
        if not self.going or self.request < 240:
            return f"the hand is open (requested position {self.request} of {CLOSED}); call close_hand"
        if self.motion == HandMotion.MOVING:
            return "the fingers are moving"
        return ""
