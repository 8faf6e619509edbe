"""The one family of exceptions: each says what is wrong, what was got, what was expected and what would help."""

from __future__ import annotations

__all__ = ["BagError", "FrameError", "InputError", "ModelFileError", "PerceptionError", "PlanningError", "PushIdentError"]


class PushIdentError(Exception):
    """Base of everything this package raises on purpose. Its text is one line that a user can act on."""


class InputError(PushIdentError):
    """A value handed in has the wrong shape, unit range or combination."""


class BagError(PushIdentError):
    """A bag cannot be read, or lacks what the bag contract asks for."""


class ModelFileError(PushIdentError):
    """A model file cannot be read or was not written by this package."""


class FrameError(PushIdentError):
    """A depth frame or its camera info is refused (encoding, size, intrinsics, frame)."""


class PerceptionError(PushIdentError):
    """Nothing usable was seen; the text carries the counts that show why."""


class PlanningError(PushIdentError):
    """A push cannot be planned within the limits. `code` is the ExecutePush result code."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code
