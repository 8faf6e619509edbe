"""Axes of other programs: motion capture often has y up. Positions and attitudes are brought to a frame with z up."""

from __future__ import annotations

from typing import Final

import numpy as np

from push_ident.errors import BagError, InputError
from push_ident.limits import plain_text
from push_ident.types import Float64Array

_NAMES: Final = "xyz"
_MOST_TILT: Final = float(np.radians(10.0))
"""Largest angle between the body's z axis and the vertical at which a planar pose is meant [rad]: 10 degrees shorten lengths by 1.5 %."""
_NOTED_TILT: Final = float(np.radians(2.0))


def parse_axes(text: str, option: str) -> Float64Array:
    """Rotation, shape (3, 3), from axes of a file to those of `table`: `x,-z,y` says that x of the table is x of the file, y is -z, z is y.

    Raises InputError for another form, or for axes that are left-handed.
    """
    rotation = np.zeros((3, 3))
    parts = [part.strip().lower() for part in text.split(",")]
    names = [part.removeprefix("-").removeprefix("+") for part in parts]
    if sorted(names) != sorted(_NAMES):
        raise InputError(f"{option} is {plain_text(text)!r}, expected x, y and z of the file in the order of the table's axes, as x,-z,y.")
    for row, (part, name) in enumerate(zip(parts, names, strict=True)):
        rotation[row, _NAMES.index(name)] = -1.0 if part.startswith("-") else 1.0
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{option} is {plain_text(text)}, which is a mirror image; change one sign: axes are right-handed, z up.")
    return rotation


def planar_of(quaternion: Float64Array, axes: Float64Array, what: str, notes: list[str], remedy: str = "") -> Float64Array:
    """Yaw [rad], shape (n,), of quaternions (x, y, z, w) of a body in a file, shape (n, 4), which has the axes of the file while its yaw is
    zero.

    `axes`: as of `parse_axes`; `what`: file or topic, `remedy`: another remedy, for messages; `notes` gets a line where the body tilts.
    Raises BagError for quaternions that are none, or a body whose z axis is not up.
    """
    from scipy.spatial.transform import Rotation

    length = np.linalg.norm(np.clip(quaternion, -2.0, 2.0), axis=1)  # a number that is far off does not overflow
    if wrong := int(np.sum(np.abs(length - 1.0) > 0.05)):
        raise BagError(f"{what}: {wrong} of {len(length)} quaternions have a length other than 1; check the order qx, qy, qz, qw.")
    turn = axes @ Rotation.from_quat(quaternion).as_matrix() @ axes.T
    tilt = np.arccos(np.clip(turn[:, 2, 2], -1.0, 1.0))
    if (middle := float(np.median(tilt))) > _MOST_TILT:
        raise BagError(
            f"{what}: the body's z axis is tilted by {np.degrees(middle):.0f} degrees, expected at most {np.degrees(_MOST_TILT):.0f}; "
            "define the rigid body with z up while the object lies on the table; give --axes x,-z,y for a file with y up, x,y,z for "
            f"z up{remedy}."
        )
    if (most := float(tilt.max())) > _NOTED_TILT:
        notes.append(f"the object tilts by up to {np.degrees(most):.1f} degrees; its planar pose is used")
    return np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
