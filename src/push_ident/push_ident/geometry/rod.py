"""A cylinder in space: a link of an arm, as perception needs it without the kinematics of the arm."""

from __future__ import annotations

from dataclasses import dataclass

from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class Rod:
    """A cylinder with flat ends and any direction."""

    start: Float64Array
    """Centre of one end [m], shape (3,)."""
    end: Float64Array
    """Centre of the other end [m], shape (3,)."""
    radius: float
    """[m]"""

    def moved(self, pose: Float64Array) -> Rod:
        """The rod in another frame; `pose`, shape (4, 4), is the pose of this rod's frame in that one."""
        return Rod(pose[:3, :3] @ self.start + pose[:3, 3], pose[:3, :3] @ self.end + pose[:3, 3], self.radius)

    @property
    def lowest(self) -> float:
        """Lower bound of the height of the rod [m]."""
        return float(min(self.start[2], self.end[2])) - self.radius
