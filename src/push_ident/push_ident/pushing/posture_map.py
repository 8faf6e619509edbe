"""Postures of the arm for every position that the lowered tool may be steered to, solved and checked before anything moves.

While a push is corrected there is no time for inverse kinematics, and a refusal would come too late. So the postures are solved at the
nodes of a grid, each from that of its neighbour, and interpolated by cubics: over 2 cm they are exact to some micrometres. Joint velocities
are the derivative of the map times the velocity of the tool.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import RectBivariateSpline

from push_ident.errors import PlanningError
from push_ident.geometry.kinematics import TOOL_DOWN, ArmKinematics
from push_ident.pushing.arm_motion import JointLimits
from push_ident.pushing.push import PushCode
from push_ident.pushing.tool_path import Corridor, ToolMotion
from push_ident.types import Float64Array


@dataclass(frozen=True, slots=True)
class PostureGrid:
    """Grid of the postures of a corridor."""

    spacing: float = 0.02
    """Largest distance between nodes [m]."""
    least_nodes: int = 5
    """Least number of nodes along each side."""
    margin: float = 0.01
    """Margin of the grid around the corridor [m]: rounding the corners of a path may lead so far out of it."""
    posture_rate: float = 3.0
    """Drift towards the neutral posture per metre of tool travel, as on straight pushes [1/m]."""
    acceleration_share: float = 0.9
    """Share of the acceleration limits that is used [1]: between nodes and samples the acceleration is a little larger than at them."""
    tolerance: float = 1e-8
    """Tolerance of the inverse kinematics at a node [m, rad]: cubics amplify its errors."""


_GRID: Final = PostureGrid()


class PostureMap:
    """Postures over the part of a corridor that lies in the workspace, with the tool down, its spin and height held.

    Args:
        q_start: posture with the tool where the push begins [rad].
        corridor: in which the tool may be.
        workspace: x_min, x_max, y_min, y_max of the tool [m].

    Raises PlanningError: UNREACHABLE where the arm has no posture for a position in the corridor.
    """

    def __init__(
        self, kinematics: ArmKinematics, q_start: Float64Array, corridor: Corridor, workspace: tuple[float, float, float, float]
    ) -> None:
        pose = kinematics.forward(q_start)
        self._kinematics, self._corridor = kinematics, corridor
        self._height, self._x_axis = float(pose[2, 3]), pose[:3, 0]
        start = pose[:2, 3]
        low, high = np.array(workspace)[[0, 2]], np.array(workspace)[[1, 3]]
        inner = (
            np.maximum(corridor.line.min(axis=0) - corridor.half_width, low),
            np.minimum(corridor.line.max(axis=0) + corridor.half_width, high),
        )
        first, last = np.minimum(inner[0], start) - _GRID.margin, np.maximum(inner[1], start) + _GRID.margin
        self._x, self._y = (_nodes(*ends) for ends in zip(first, start, last, strict=True))
        postures, self._low_links = self._solved(q_start, start)
        self._splines = [RectBivariateSpline(self._x, self._y, joint) for joint in np.moveaxis(postures, -1, 0)]
        self._postures = postures

    def joints(self, motion: ToolMotion) -> tuple[Float64Array, Float64Array]:
        """Positions [rad] and velocities [rad/s] of the joints at the samples of a motion, both of shape (n, n_joints)."""
        x, y = motion.position.T
        position = np.column_stack([spline.ev(x, y) for spline in self._splines])
        by_x = np.column_stack([spline.ev(x, y, dx=1) for spline in self._splines])
        by_y = np.column_stack([spline.ev(x, y, dy=1) for spline in self._splines])
        return position, by_x * motion.velocity[:, :1] + by_y * motion.velocity[:, 1:]

    def allowed(self, speed: float, acceleration: float, limits: JointLimits, link_height: float) -> tuple[float, float]:
        """Largest speed [m/s] and acceleration [m/s^2] that the tool may have anywhere in the corridor, in any direction.

        Args:
            speed: requested speed of the tool.
            acceleration: requested acceleration of the tool.
            link_height: least height of a moving joint [m].

        Raises PlanningError: LIMIT where a joint would be lower.
        """
        inside = self._distance() <= 0.0
        low = np.where(inside, self._low_links, np.inf)
        if float(low.min()) < link_height:
            i, j = np.unravel_index(int(np.argmin(low)), low.shape)
            raise PlanningError(
                PushCode.LIMIT,
                f"a joint would be {low.min():.3f} m above the table with the tool at ({self._x[i]:.3f}, {self._y[j]:.3f}) m, limit "
                f"{link_height:.3f} m; give a narrower corridor.",
            )
        at = self._x, self._y
        slope = np.stack([np.hypot(s(*at, dx=1), s(*at, dy=1))[inside] for s in self._splines], axis=-1)
        bends = [np.sqrt(s(*at, dx=2) ** 2 + 2.0 * s(*at, dx=1, dy=1) ** 2 + s(*at, dy=2) ** 2)[inside] for s in self._splines]
        speed = min(speed, float(np.min(limits.velocity / np.maximum(slope, 1e-9))))
        # At speed, joints accelerate where the posture bends over the table.
        available = np.maximum(_GRID.acceleration_share * limits.acceleration - speed**2 * np.stack(bends, axis=-1), 0.0)
        return speed, min(acceleration, float(np.min(available / np.maximum(slope, 1e-9))))

    def _distance(self) -> Float64Array:
        """Distance of the nodes from the corridor [m], shape (n_x, n_y); 0 inside."""
        return self._corridor.excess(np.stack(np.meshgrid(self._x, self._y, indexing="ij"), axis=-1))

    def _solved(self, q_start: Float64Array, start: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Postures at the nodes, shape (n_x, n_y, n_joints), and the height of the lowest moving joint there [m], shape (n_x, n_y)."""
        postures, low = np.empty((len(self._x), len(self._y), len(q_start))), np.empty((len(self._x), len(self._y)))
        far = self._distance() > 2.0 * _GRID.spacing
        i0, j0 = int(np.argmin(np.abs(self._x - start[0]))), int(np.argmin(np.abs(self._y - start[1])))
        for i in _outwards(i0, len(self._x)):
            before = i0 if i == i0 else i - int(np.sign(i - i0))
            for j in _outwards(j0, len(self._y)):
                from_node = (before, j0) if j == j0 else (i, j - int(np.sign(j - j0)))
                q = q_start if (i, j) == (i0, j0) else postures[from_node]
                postures[i, j], converged = self._posture(q, i, j, from_node)
                if not (converged or far[i, j]):
                    raise PlanningError(
                        PushCode.UNREACHABLE,
                        f"the tool cannot reach ({self._x[i]:.3f}, {self._y[j]:.3f}) m, in the corridor of the push or beside it; "
                        "give a narrower corridor, or a path further inside.",
                    )
                self._kinematics.forward(postures[i, j])
                low[i, j] = self._kinematics.lowest_joint()[1]
        return postures, low

    def _posture(self, q: Float64Array, i: int, j: int, from_node: tuple[int, int]) -> tuple[Float64Array, bool]:
        step = float(np.hypot(self._x[i] - self._x[from_node[0]], self._y[j] - self._y[from_node[1]]))
        q = q + _GRID.posture_rate * step * (self._kinematics.neutral - q)
        position = np.array([self._x[i], self._y[j], self._height])
        return self._kinematics.inverse(position, q, axis=TOOL_DOWN, x_axis=self._x_axis, posture_gain=0.0, tolerance=_GRID.tolerance)


def _outwards(middle: int, n: int) -> list[int]:
    return [*range(middle, n), *range(middle - 1, -1, -1)]


def _nodes(first: float, start: float, last: float) -> Float64Array:
    """Ascending, with both ends and the start among them [m]."""
    n = [max(2, int(np.ceil((b - a) / _GRID.spacing)) + 1, (_GRID.least_nodes + 1) // 2) for a, b in ((first, start), (start, last))]
    return np.unique(np.concatenate([np.linspace(first, start, n[0]), np.linspace(start, last, n[1])]))
