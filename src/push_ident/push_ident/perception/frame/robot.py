"""Where tool and arm were when an image was taken."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.rod import Rod
from push_ident.limits import LIMITS
from push_ident.types import Float64Array

if TYPE_CHECKING:  # it needs pinocchio, which a wheel without ROS has not
    from push_ident.geometry.arm_shape import ArmShape


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A vertical cylinder of the robot without upper end [m], table frame."""

    x: float
    y: float
    radius: float
    z_min: float = -1.0
    """Height of its lower end."""


RobotPart = Cylinder | Rod
"""Tool and hand, placed by the pose of the tool, or links of the arm, placed by its joint states."""


class RobotHistory:
    """Keeps recent states of tool and arm and interpolates between them.

    Args:
        tool_radius: radius of the cylinder at the tip [m].
        tool_length: from the tip to the hand [m].
    """

    def __init__(self, tool_radius: float, tool_length: float) -> None:
        self.tool_radius, self.tool_length = tool_radius, tool_length
        self.arm_shape: ArmShape | None = None
        """Links of the arm; None until its description is known."""
        self._tool: deque[tuple[float, Float64Array]] = deque(maxlen=200)  # 3 s at 60 Hz
        self._joints: dict[str, deque[tuple[float, float]]] = {}

    def add_tool(self, stamp: float, position: Float64Array) -> None:
        """Position of the tip at `stamp` [s], shape (3,), table frame [m]; an older stamp begins anew."""
        if self._tool and stamp < self._tool[-1][0]:
            self._tool.clear()
        self._tool.append((stamp, position))

    def add_joints(self, stamp: float, names: Sequence[str], position: Float64Array) -> None:
        """Joint positions [rad, m] at `stamp` [s], of all joints or, as of arm and gripper in turn, of some; an older stamp of a joint
        begins that one anew.

        Raises InputError for numbers that are not finite, or not one for each name, or more joints than any cell has.
        """
        if len(position) != len(names) or not np.isfinite(position).all():
            raise InputError(f"{len(position)} positions for {len(names)} joints, or not finite")
        LIMITS.JOINTS.check(len(self._joints.keys() | set(names)), "Joint states, all together,")
        for name, value in zip(names, position.tolist(), strict=True):
            states = self._joints.setdefault(name, deque(maxlen=400))  # 4 s at 100 Hz
            if states and stamp < states[-1][0]:
                states.clear()
            states.append((stamp, value))

    def tool_age(self, stamp: float) -> float | None:
        """How much older than `stamp` the latest tool pose is [s]; None where there is none."""
        return stamp - self._tool[-1][0] if self._tool else None

    def joints_age(self, stamp: float) -> float | None:
        """How much older than `stamp` the latest state is of the joint, of those that place links of the arm, which is silent for longest
        [s]; None where there is none."""
        placing = self._joints.keys() if self.arm_shape is None else self.arm_shape.joints_without({})
        return max((stamp - self._joints[name][-1][0] for name in placing if name in self._joints), default=None)

    @property
    def unknown_joints(self) -> list[str]:
        """Joints of the arm of which no state has come: links behind them are not placed."""
        return [] if self.arm_shape is None else self.arm_shape.joints_without(dict.fromkeys(self._joints, 0.0))

    def tool_at(self, stamp: float, hand_radius: float) -> tuple[RobotPart, ...]:
        """Tool and hand at `stamp` [s]; nothing without tool poses. `hand_radius` [m] is that of the hand above the tool."""
        if not self._tool:
            return ()
        times = np.array([time for time, _ in self._tool])
        positions = np.array([position for _, position in self._tool])
        x, y, z = (float(np.interp(stamp, times, positions[:, axis])) for axis in range(3))
        return Cylinder(x, y, self.tool_radius, z), Cylinder(x, y, hand_radius, z + self.tool_length)

    def joints_at(self, stamp: float) -> dict[str, float]:
        """Joint positions at `stamp` [rad, m] by name, linear between the states around it, held outside; empty without joint states."""
        return {name: float(np.interp(stamp, *np.array(states).T)) for name, states in self._joints.items()}

    def arm_at(self, stamp: float, reach: float) -> tuple[RobotPart, ...]:
        """Links of the arm at `stamp` [s] that come below the height `reach` [m]; nothing without description or joint states.

        What is higher than every object is labelled as robot anyway.
        """
        if self.arm_shape is None or not self._joints:
            return ()
        return tuple(rod for rod in self.arm_shape.at(self.joints_at(stamp)) if rod.lowest < reach)
