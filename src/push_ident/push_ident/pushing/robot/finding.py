"""What a check of a robot found."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

__all__ = ["Finding", "Level"]


class Level(StrEnum):
    """How bad it is."""

    OK = "ok"
    NOT_CHECKED = "not checked"
    WARNING = "warning"
    """It works, but worse than it could, or another push would be refused."""
    WRONG = "wrong"
    """The robot cannot push like this."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    about: str
    """Part of the robot file: `joints`, `reach`, ..."""
    level: Level
    what: str
    """What was found, with its numbers."""
    expected: str = ""
    remedy: str = ""

    @property
    def text(self) -> str:
        """All of it in one line."""
        return "; ".join(part for part in (self.what, self.expected and f"expected {self.expected}", self.remedy) if part)
