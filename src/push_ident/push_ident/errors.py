"""The exceptions of the package. Each text gives the problem, the value found, the value expected and a remedy."""

from __future__ import annotations


class PushIdentError(Exception):
    """Base of all exceptions that this package raises deliberately. Its text is one line with a remedy."""


class InputError(PushIdentError):
    """An argument has a wrong shape, range or combination."""


class BagError(PushIdentError):
    """A bag cannot be read, or lacks something that the bag contract requires."""


class ContentError(BagError):
    """A bag that is whole holds something that cannot be used: recording or recovering it again does not help."""


class ModelFileError(PushIdentError):
    """A model file cannot be read or was not written by this package."""


class FrameError(PushIdentError):
    """A depth frame or its camera info is refused (encoding, size, intrinsics, frame)."""


class PerceptionError(PushIdentError):
    """The depth images contain nothing usable; the text gives the counts that show why."""


class PlanningError(PushIdentError):
    """A push cannot be planned within the limits. `code` is the ExecutePush result code."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code
