"""Several objects to their goals, one after another: whose turn it is, and who has to make room first.

An object whose goal another one lies on waits for that one. Where all wait for each other, one is moved aside first. An object that no push
could bring nearer is tried again once another one has moved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from push_ident.errors import InputError
from push_ident.geometry.se2 import transform_points
from push_ident.planning.goal import Goal
from push_ident.planning.keep_out import distance_between
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array

_ANGLE_ASIDE: Final = 0.3
"""Largest angle to a place aside [rad]: there it matters only that the object is out of the way."""
_STEP: Final = 0.02
"""Between places aside that are tried [m]: the tolerance of a goal."""
_MOST_TURNS: Final = 4
"""Turns of each object at most, those to make room included: each object makes room for each of three others, and goes to its goal."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObject:
    """An object on the table."""

    outline: Float64Array
    """Object frame [m], shape (n_vertices, 2)."""
    pose: Float64Array
    """Table frame, shape (3,)."""

    def at(self, pose: Float64Array) -> Float64Array:
        """Its outline at a pose, shape (3,), table frame [m]."""
        return transform_points(pose, self.outline)


@dataclass(frozen=True, slots=True)
class Turn:
    """What is to be pushed where."""

    object_id: str
    goal: Goal
    is_aside: bool
    """Whether it makes room, and its own goal comes later."""


class NoTurnError(InputError):
    """No object can be pushed to its goal, though not all are there."""


@dataclass(slots=True)
class SeveralGoals:
    """Goals of several objects.

    Args:
        goals: of the objects by id, in the order that is preferred.
        settings: limits of pushes and the pusher.
    """

    goals: Mapping[str, Goal]
    settings: PushSettings
    _reached: set[str] = field(default_factory=set)
    _failed: set[str] = field(default_factory=set)
    """That were tried in vain since an object moved last."""
    _turns: dict[str, int] = field(default_factory=dict)

    @property
    def room(self) -> float:
        """Distance between two objects in which the tool can be lowered [m]."""
        return 2.0 * (self.settings.tool.reach + self.settings.lowering_gap)

    def check(self, objects: Mapping[str, PlacedObject]) -> None:
        """Raise InputError for an object that is not there, and for goals at which two objects would overlap."""
        if missing := [name for name in self.goals if name not in objects]:
            raise InputError(f"no object `{missing[0]}` with pose and cells; known: {', '.join(sorted(objects)) or 'none'}.")
        names = list(self.goals)
        for k, one in enumerate(names):
            for other in names[:k]:
                ends = (objects[name].at(self.goals[name].pose) for name in (one, other))
                if distance_between(*ends) < 0.0:
                    raise InputError(f"the goals of `{other}` and `{one}` overlap; choose goals that are further apart.")

    def note(self, turn: Turn, *, is_reached: bool, has_moved: bool) -> None:
        """Take how a turn ended: whether the object is where it should be, and whether it was pushed at all."""
        if has_moved:
            self._failed.clear()
        if not is_reached:
            self._failed.add(turn.object_id)
        elif not turn.is_aside:
            self._reached.add(turn.object_id)

    def next(self, objects: Mapping[str, PlacedObject]) -> Turn | None:
        """Whose turn it is, by where all objects of the table lie now; None where all goals are reached.

        Raises:
            NoTurnError: no object can be pushed to its goal.
        """
        waiting = [name for name in self.goals if name not in self._reached]
        if not waiting:
            return None
        blockers = {name: self._blockers(name, objects) for name in waiting}
        wanted = [name for names in blockers.values() for name in names]
        # Who lies on the goal of another one goes first.
        ready = sorted((name for name in waiting if not blockers[name] and self._may(name)), key=lambda name: -wanted.count(name))
        if ready:
            return self._begin(Turn(ready[0], self.goals[ready[0]], is_aside=False))
        for name in sorted(set(wanted), key=lambda name: -wanted.count(name)):
            if name in self.goals and self._may(name) and (aside := self._aside(name, objects)) is not None:
                self._reached.discard(name)
                return self._begin(Turn(name, aside, is_aside=True))
        raise NoTurnError(self._why(waiting, blockers))

    def _may(self, name: str) -> bool:
        return name not in self._failed and self._turns.get(name, 0) < _MOST_TURNS

    def _begin(self, turn: Turn) -> Turn:
        self._turns[turn.object_id] = self._turns.get(turn.object_id, 0) + 1
        return turn

    def _blockers(self, name: str, objects: Mapping[str, PlacedObject]) -> list[str]:
        """Objects that lie where one is to be."""
        end = objects[name].at(self.goals[name].pose)
        return [other for other, one in objects.items() if other != name and distance_between(end, one.at(one.pose)) < 0.0]

    def _aside(self, name: str, objects: Mapping[str, PlacedObject]) -> Goal | None:
        """The nearest place at which an object is on no goal and leaves room for the tool; None where there is none."""
        moved = objects[name]
        taken = [other.at(other.pose) for key, other in objects.items() if key != name]
        taken += [objects[key].at(goal.pose) for key, goal in self.goals.items() if key != name]
        x_min, x_max, y_min, y_max = self.settings.workspace
        places = np.stack(np.meshgrid(np.arange(x_min, x_max, _STEP), np.arange(y_min, y_max, _STEP)), axis=-1).reshape(-1, 2)
        for place in places[np.argsort(np.linalg.norm(places - moved.pose[:2], axis=1))]:
            pose = np.append(place, moved.pose[2])
            outline = moved.at(pose)
            if self.settings.excess(outline) == 0.0 and all(distance_between(outline, other) > self.room for other in taken):
                return Goal(pose, yaw=_ANGLE_ASIDE)
        return None

    def _why(self, waiting: Sequence[str], blockers: Mapping[str, Sequence[str]]) -> str:
        parts = [
            f"`{name}` "
            + (f"has {', '.join(f'`{other}`' for other in blockers[name])} on its goal" if blockers[name] else "cannot get there")
            for name in waiting
        ]
        return f"{'; '.join(parts)}: make room, or choose other goals."
