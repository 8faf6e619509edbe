"""The planar engine behind the interface of `PushWorld`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import PushIdentError
from push_ident.physics.support import GRAVITY
from push_ident.types import Float64Array, PusherPath
from push_ident_sim.engines.planar.integrator import Body, Clock, Path, State, StepChange, advance, bed_loads, new_state
from push_ident_sim.engines.planar.laws import Laws, laws_of
from push_ident_sim.engines.true_motion import TrueMotion, checked_pose
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.injected.equations import TableEquations
from push_ident_sim.injected.shared import ToolErrors
from push_ident_sim.objects import SimObject


class PlanarWorld:
    """An object on a table and a disc that follows a path, as `PushWorld`, by other laws. An object that tips over is an error."""

    def __init__(
        self,
        sim_object: SimObject,
        pusher_radius: float,
        *,
        time_step: float = 1.0 / 240.0,
        inner_steps: int = 96,
        effects: InjectedEffects | None = None,
        outside: Mapping[str, float] | None = None,
    ) -> None:
        """`pusher_radius` [m] > 0. A row of a motion every `time_step` [s], of `inner_steps` steps each; `outside`: see `OUTSIDE`."""
        self.pusher_radius = pusher_radius
        self.time_step = time_step
        self._inner_steps = inner_steps
        self._sim_object = sim_object
        self._effects = effects or InjectedEffects()
        self._outside = dict(outside or {})
        mass = float(sim_object.mass.sum())
        self._centre = sim_object.mass @ sim_object.cells / mass
        arms = np.ascontiguousarray(sim_object.cells - self._centre)
        self._body = Body(
            arms=arms,
            friction=np.array(sim_object.friction),
            outline=np.ascontiguousarray(sim_object.outline - self._centre),
            mass=mass,
            inertia=float(sim_object.mass @ (np.sum(arms**2, axis=1) + sim_object.cell_size**2 / 6.0)),
        )
        self._equations = TableEquations(sim_object, self._effects)
        self._first_centre: tuple[float, float] | None = None

    def push(
        self,
        pose_object_in_table: ArrayLike,
        path: PusherPath,
        *,
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        pushes_done: int = 0,
        rest_speed: float = 1e-4,
        longest_rest: float = 1.0,
    ) -> TrueMotion:
        """Place the object and move the pusher along `path`, then wait until the object rests; as `PushWorld.push`.

        Raises:
            InputError: a pose or velocity that is not three finite numbers.
            PushIdentError: the object tips over.
        """
        pose, speed = checked_pose(pose_object_in_table), checked_pose(velocity)
        arm = _turned(self._centre, pose[2])
        first = np.array([*(pose[:2] + arm), pose[2]])
        first_velocity = speed + np.array([-speed[2] * arm[1], speed[2] * arm[0], 0.0])
        if self._first_centre is None:
            self._first_centre = (float(first[0]), float(first[1]))
        clock, true_path = self._true_path(path, pushes_done)
        laws = laws_of(
            self._effects,
            self._outside,
            self._sim_object,
            pusher_radius=self.pusher_radius,
            gravity=GRAVITY,
            pushes_done=pushes_done,
            first_centre=self._first_centre,
        )
        n_rows = int(np.ceil((clock[-1] + longest_rest) / self.time_step))
        times = Clock(self.time_step, self._inner_steps, rest_speed)
        start = new_state(self._body, Path(clock, true_path), first, first_velocity, self._body.mass * laws.gravity)
        centres, pusher, force, stands_throughout = self._integrate(laws, Path(clock, true_path), start, times, n_rows, pushes_done)
        if not stands_throughout:
            raise PushIdentError(f"{self._sim_object.name} tips over: its load leaves its base; push it lower or with less loose contents.")
        poses = centres.copy()
        poses[:, :2] -= np.array([_turned(self._centre, yaw) for yaw in centres[:, 2]])
        time = np.arange(len(poses)) * np.float64(self.time_step)
        since = path.time - path.time[0]
        reported = np.column_stack([np.interp(time, since, path.position[:, axis]) for axis in (0, 1)])
        return TrueMotion(time, poses, pusher, reported if ToolErrors.needed(self._effects) else pusher, force)

    def _integrate(
        self, laws: Laws, path: Path, start: tuple[State, bool], clock: Clock, n_rows: int, pushes_done: int
    ) -> tuple[Float64Array, Float64Array, Float64Array, bool]:
        """Rows of pose of the centre of mass, pusher and force until the push is over, and whether the object stood all the time."""
        state, stands = start
        n_cells = len(self._sim_object)
        change = StepChange(np.ones(n_cells), np.zeros(2), np.zeros(3))
        poses, positions, forces = [state.pose[None].copy()], [state.pusher[None].copy()], [np.zeros((1, 2))]
        self._equations.start()
        # Further effects hold during a row; without any, all rows are made in one call.
        stride = 1 if self._equations else n_rows
        row, over = 1, False
        while stands and not over and row <= n_rows:
            if self._equations:
                limit = state.load * self._body.friction
                now = self._equations.advance(state.pose, state.velocity, limit, clock.row_time, pushes_done)
                change = StepChange(now.factor, now.skew, now.wrench)
            pose, position, force, stands, over = advance(laws, self._body, path, state, change, clock, row, stride)
            row += len(pose)
            poses.append(pose)
            positions.append(position)
            forces.append(force)
        return np.concatenate(poses), np.concatenate(positions), np.concatenate(forces), stands

    def _true_path(self, path: PusherPath, pushes_done: int) -> tuple[Float64Array, Float64Array]:
        """True path of the tool: times from 0 [s], shape (n,), and positions [m], shape (n, 2)."""
        since = path.time - path.time[0]
        if not ToolErrors.needed(self._effects):
            return since, np.array(path.position)
        step, rest = 1e-3, 0.4  # time step of the tool, and time for which it is followed after the path [s]
        tool = ToolErrors(self._effects, step)
        tool.pushes_done = pushes_done
        tool.start(path.position[0])
        # It may lag or circle.
        clock = np.arange(0.0, since[-1] + rest, step)
        reported = np.column_stack([np.interp(clock, since, path.position[:, axis]) for axis in (0, 1)])
        return clock, np.array([tool.true_position(position) for position in reported])

    def cell_loads(self) -> Float64Array:
        """Normal force of the table on each cell at rest and without effects [N], shape (n_cells,)."""
        bears, load = np.array(self._sim_object.friction) > 0.0, np.empty(len(self._sim_object))
        weight = self._body.mass * GRAVITY
        bed_loads(self._body.arms, bears, weight, np.zeros(2), np.array([weight / len(load), 0.0, 0.0]), load)
        return load

    def close(self) -> None:
        """Nothing to free; as in `PushWorld`."""


def _turned(point: Float64Array, yaw: float) -> Float64Array:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])
