"""Limits of what comes from outside: messages, bags, files.

A claim is compared with its limit before memory is taken or a loop is started for it, so time and memory stay bounded whatever bytes from
outside claim. Every limit is far above what an honest cell sends; none bounds the length of a recording.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from push_ident.errors import InputError, PushIdentError

_ID: Final = re.compile(r"[A-Za-z0-9_]+")
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ud800-\udfff\ufeff]")
_CONTROL_IN_LINES: Final = re.compile(_CONTROL.pattern.replace("\\x00-\\x1f", "\\x00-\\x08\\x0b-\\x1f"))
_ANSI: Final = re.compile(r"\x1b\[[0-9;?]*[ -/]*[@-~]")
"""Colours and movements of the cursor, as libraries write them (ECMA-48, CSI)."""


@dataclass(frozen=True, slots=True)
class Limit:
    """The largest value of one quantity from outside."""

    value: int
    unit: str
    meaning: str
    source: str
    """Why this value."""

    def check(self, got: float, what: str, *, error: type[PushIdentError] = InputError, remedy: str = "") -> None:
        """Raise `error` unless `got` is at most the limit; NaN is refused. `what` names the thing that claims it."""
        if not got <= self.value:
            raise error(f"{what}: {self.meaning} {_short(got)}, expected at most {_short(self.value)} {self.unit}. {remedy}".rstrip())


def _short(number: float) -> str:
    return (
        f"{number:,}" if isinstance(number, int) and abs(number) < 10**18 else f"{number:.3g}" if abs(number) < 10**300 else "beyond 1e300"
    )


class LIMITS:
    """Every limit of the suite."""

    # ---- objects
    CELLS: Final = Limit(
        1_000,
        "cells",
        "number of cells of one object is",
        "objects have 50 to 150 cells; the covariance of the maps grows with the square, a fit with the cube",
    )
    GRID: Final = Limit(4_000_000, "cells", "width * height of an occupancy grid is", "2 m x 2 m at 1 mm")
    VERTICES: Final = Limit(
        2_000, "vertices", "number of vertices of an outline is", "an outline traced at 1 mm around 0.5 m; contact looks at every edge"
    )
    OBJECTS: Final = Limit(50, "objects", "number of objects is", "the suite is tested with 10 at once")
    EXTENT: Final = Limit(5, "m", "extent of an object is", "the reach of a large arm; 60 mm in millimetres are 60")
    PUSHER_RADIUS: Final = Limit(1, "m", "radius of a pusher is", "a tool is some centimetres wide; 8 mm in millimetres are 8")
    COORDINATE: Final = Limit(
        100,
        "m",
        "a coordinate is",
        "the table frame has its origin in the middle of the workspace; beyond, a covariance in single precision loses the millimetre",
    )
    FORCE: Final = Limit(100_000, "N", "a force is", "far above the force of any arm")
    MASS: Final = Limit(10_000, "kg", "a mass is", "what the largest force just moves at a friction coefficient of 1")
    FRICTION: Final = Limit(
        100,
        "times the normal force",
        "a friction coefficient is",
        "tyres of dragsters reach 5; from 10 on a contact sticks at any push, so a fit may overshoot",
    )
    YAW: Final = Limit(100, "rad", "a yaw is", "16 turns of an object in one push; messages have it within half a turn")

    # ---- pushes
    PUSHES: Final = Limit(2_000, "pushes", "number of pushes is", "a push each 15 s for 8 hours")
    PUSH_SECONDS: Final = Limit(600, "s", "duration of a push is", "0.5 m at 1 mm/s; the simulation steps through it")
    PUSH_TRAVEL: Final = Limit(20, "m", "path of the pusher in one push is", "ten times across a table of 2 m")

    # ---- images
    IMAGE_SIDE: Final = Limit(8_192, "pixels", "side of an image is", "structured-light cameras have up to 2448")
    IMAGE_PIXELS: Final = Limit(5_013_504, "pixels", "width * height of an image is", "2448 x 2048, the largest structured-light cameras")

    # ---- messages
    MESSAGE: Final = Limit(33_554_432, "bytes", "size of a message is", "the largest image in 32FC1, with padded rows")
    SMALL_MESSAGE: Final = Limit(
        1_048_576,
        "bytes",
        "size of a message is",
        "all but images and grids: an outline of 2000 vertices has 24 kB, 1000 transforms 0.1 MB",
    )
    STRING: Final = Limit(1_024, "characters", "length of a string is", "names of frames, topics and objects; DDS allows 255 for a topic")
    DESCRIPTION: Final = Limit(4_194_304, "characters", "length of a robot description is", "URDF of two arms with hands: 0.2 MB")
    JOINTS: Final = Limit(100, "joints", "number of joints is", "two arms and two hands: 60")
    POINTS: Final = Limit(10_000, "points", "number of points of a path is", "100 s at 100 Hz")
    STAMP: Final = Limit(2**31 - 1, "s", "a stamp is", "seconds are signed 32-bit integers in ROS")
    OBJECT_ID: Final = Limit(100, "characters", "length of an object id is", "a name of a topic of 255 has it in the middle")
    SHOWN: Final = Limit(400, "characters", "foreign text that is repeated in a log or a status has", "a few lines of a terminal")
    TRANSFORMS: Final = Limit(1_000, "transforms", "number of transforms is", "a cell has some tens of frames")

    # ---- bags
    RECORD: Final = Limit(67_108_864, "bytes", "size of a record is", "twice the largest message; rosbag2 closes a chunk at 0.8 MB")
    CHUNK: Final = Limit(
        67_108_864,
        "bytes",
        "size of an uncompressed chunk is",
        "one largest message beside a full chunk; rosbag2 closes a chunk at 0.8 MB, ROS 1 too",
    )
    EXPANSION: Final = Limit(
        10, "times the size of the file, and 1 GB", "content uncompressed is", "depth images and joint states compress 2 to 6 times"
    )
    UNCOMPRESSED: Final = Limit(1_000_000_000, "bytes", "content uncompressed is", "what a file of any size may have")
    TOPICS: Final = Limit(2_000, "topics", "number of topics is", "a large robot has 300")
    SCHEMA: Final = Limit(
        262_144, "characters", "length of a message definition is", "the largest of ROS 2 Jazzy, with all it uses, has 20,000"
    )
    NESTING: Final = Limit(20, "levels", "nesting of message types is", "those of ROS have up to 8")
    ARRAY: Final = Limit(10_000, "messages", "length of a fixed array is", "the decoder is compiled with one line for each")
    FIELDS: Final = Limit(10_000, "fields", "number of fields of a type and of those it uses is", "the largest of ROS has some hundred")
    METADATA: Final = Limit(1_048_576, "bytes", "size of metadata.yaml is", "0.7 kB a topic, 0.3 kB a file: 1000 topics and 1000 files")
    FILES: Final = Limit(10_000, "files", "number of storage files is", "a bag that is split each minute for a week")
    SUMMARY: Final = Limit(67_108_864, "bytes", "size of the index of a bag is", "0.2 kB for a chunk of 0.8 MB: enough for 250 GB")
    TEXT_FILE: Final = Limit(16_777_216, "bytes", "size of a text file is", "the largest published recording has 1.9 MB")


def check_coordinates(values: object, what: str, *, error: type[PushIdentError] = InputError) -> None:
    """Raise `error` for coordinates [m] that are not finite or beyond `LIMITS.COORDINATE`; `values` is any array of numbers."""
    import numpy as np

    numbers = np.abs(np.asarray(values, dtype=np.float64))
    if numbers.size:
        LIMITS.COORDINATE.check(float(numbers.max()), what, error=error, remedy="Give lengths in metres, in the table frame.")


def check_object_id(text: str) -> str:
    """The same text; raises InputError unless it can stand in the name of a topic: letters, digits and underscores."""
    LIMITS.OBJECT_ID.check(len(text), "Object id")
    if not _ID.fullmatch(text):
        raise InputError(f"Object id is {plain_text(text)!r}, expected letters, digits and underscores, as in the name of a topic.")
    return text


def plain_text(text: str) -> str:
    """Foreign text for one line of a log or a status: no control characters, not longer than `LIMITS.SHOWN`."""
    most = LIMITS.SHOWN.value
    shown = _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text[:most])
    return shown if len(text) <= most else shown + "…"


def printable(text: str) -> str:
    """Foreign text for a terminal, of any length and number of lines: it cannot move the cursor, change colours or hide characters."""
    return _CONTROL_IN_LINES.sub("\N{REPLACEMENT CHARACTER}", _ANSI.sub("", text))
