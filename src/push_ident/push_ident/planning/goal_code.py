"""How pushing to a goal ends, and the exception of a goal that is refused."""

from __future__ import annotations

from enum import IntEnum

from push_ident.errors import InputError

__all__ = ["GoalCode", "GoalRefusedError"]


class GoalCode(IntEnum):
    """How it ended; the numbers are those of the result of action/PushToGoal, which calls success NONE: no error."""

    SUCCESS = 0
    NONE = SUCCESS
    INVALID_GOAL = -1
    UNKNOWN_OBJECT = -2
    OUTSIDE_WORKSPACE = -3
    UNREACHABLE = -4
    TOLERANCE = -5
    NOTHING_KNOWN = -6
    OBJECT_LOST = -7
    PUSH_FAILED = -8
    ARM_SILENT = -9
    TIME_LIMIT = -10
    MAX_PUSHES = -11
    CANCELED = -12
    PREEMPTED = -13
    MODEL = -14
    EDGE_UNKNOWN = -15
    NOT_HELD = -16
    FELL = -17


class GoalRefusedError(InputError):
    """A goal that cannot be reached whatever is pushed; `code` is the `GoalCode`."""

    def __init__(self, code: GoalCode, text: str) -> None:
        super().__init__(text)
        self.code = code
