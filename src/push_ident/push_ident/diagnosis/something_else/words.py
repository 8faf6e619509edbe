"""A pattern outside the catalogue in words: what acts, where and when, and what to look for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.diagnosis.something_else.evidence import Pattern
from push_ident.diagnosis.something_else.family import Acts, VariesWith
from push_ident.diagnosis.something_else.patterns import PATTERNS, waves
from push_ident.types import Float64Array

_LOOK_FOR: Final = {
    (Acts.FRICTION, VariesWith.POINT): "another surface, a film or dirt at that place of the table",
    (Acts.FRICTION, VariesWith.POSITION): "parts of the table with another surface, a film or dirt",
    (Acts.FORCE, VariesWith.POINT): "a magnet, a dent or a bump, an air stream or a cable at that place",
    (Acts.FORCE, VariesWith.POSITION): "slopes and dents of the table, magnets, air streams, cables",
    (Acts.PUSHER, VariesWith.FROM_PUSH): "a tool that came loose or was bent before that push, or an arm that lost its reference",
    (Acts.PUSHER, VariesWith.SIDE): "a bump, a seam, a label or a soft part of that side, or a wrong outline there",
    (Acts.PUSHER, VariesWith.FREQUENCY): "a vibrating or wobbling tool, play in the arm, or poses that swing",
}
"""By what acts and what it follows."""
_LOOK_FOR_BY_COORDINATE: Final = {
    VariesWith.FROM_PUSH: "what changed before that push: something spilled, worn, warmed up, moved or switched on",
    VariesWith.SINCE_CONTACT: "contents that shift or slosh, a soft contact, or friction that changes after breaking away",
    VariesWith.TRAVEL: "friction that changes while sliding: a film that is wiped away, a soft or sticky surface",
    VariesWith.SPEED: "a film of liquid, air under the object, or friction that depends on the speed by another law",
    VariesWith.HEADING: "a grain, a seam or an edge of the table",
    VariesWith.HEADING_IN_OBJECT: "feet, edges, wheels or a grain of the object's base",
    VariesWith.TIME: "an air stream, a vibration, a cable that drags, or somebody who touches the object",
}
"""Of a force, by what it follows."""


@dataclass(frozen=True, slots=True)
class PatternWords:
    """Parts of sentences."""

    what: str
    """What acts, with its size, to continue "it is"."""
    where: str
    """Where and when it acts, to continue "it acts"."""
    look_for: str
    """To continue "look for"."""


DISCREPANCY: Final = PatternWords(
    "a departure from the model larger than usual",
    "in each push in another way",
    "what differs from push to push: how the object was put down, a cable, loose contents, a base that is not flat",
)
"""Of a discrepancy that follows none of the patterns."""


def describe_pattern(pattern: Pattern, sources: Sequence[str]) -> PatternWords:
    """Describe a pattern; `sources`: of the pushes, in their order."""
    acts, varies = pattern.family.acts_on, pattern.family.varies_with
    look_for = _LOOK_FOR.get((acts, varies)) or _LOOK_FOR_BY_COORDINATE[varies]
    return PatternWords(_what(pattern), _where(pattern, sources), look_for)


def _what(pattern: Pattern) -> str:
    acts, amplitude = pattern.family.acts_on, pattern.amplitude
    size = float(np.max(np.abs(amplitude)))
    largest = float(amplitude[np.argmax(np.abs(amplitude))])
    if pattern.family.varies_with is VariesWith.SPEED:
        along = amplitude.reshape(len(PATTERNS.speeds), -1)[:, 0]  # a force against the motion is more friction
        return f"friction that differs by {100 * along[np.argmax(np.abs(along))]:+.0f} %"
    if acts is Acts.FRICTION:
        return f"friction that is {'higher' if largest > 0 else 'lower'} by up to {100 * min(size, 1.0):.0f} %"
    if acts is Acts.PUSHER:
        return f"a displacement of the pusher from its reported path by up to {size:.1f} mm"
    if pattern.family.varies_with is VariesWith.POINT:
        return f"a force {'towards' if largest > 0 else 'away from'} one place, up to {100 * size:.1f} % of the friction of the object"
    return f"a force or a torque of up to {100 * size:.1f} % of the friction of the object"


def _where(pattern: Pattern, sources: Sequence[str]) -> str:
    varies, key = pattern.family.varies_with, pattern.member.key
    decayed = 3.0  # decay times or lengths after which a pattern has faded to a twentieth
    if isinstance(key, tuple):
        return f"on everything within {1e3 * PATTERNS.radius:.0f} mm of ({1e3 * key[0]:.0f}, {1e3 * key[1]:.0f}) mm of the table"
    if varies is VariesWith.FROM_PUSH:
        assert key is not None, "this has a push"
        return f"from {sources[int(key)]} on"
    if varies is VariesWith.FREQUENCY and key is not None:
        return f"about {key:.1f} times a second in all pushes, in each with a phase of its own, so that it predicts no other one better"
    if varies is VariesWith.SINCE_CONTACT and key is not None:
        return f"in the first {decayed * key:.1f} s after contact"
    if varies is VariesWith.TRAVEL and key is not None:
        return f"in the first {1e3 * decayed * key:.0f} mm of sliding"
    return _by_amplitude(pattern)


def _by_amplitude(pattern: Pattern) -> str:
    """Where a function of a coordinate is largest."""
    family, amplitude = pattern.family, pattern.amplitude
    varies = family.varies_with
    if varies in (VariesWith.HEADING, VariesWith.HEADING_IN_OBJECT):
        frame = "table" if varies is VariesWith.HEADING else "object"
        return f"by the direction of motion in the {frame}, most towards {np.degrees(_largest_heading(amplitude)):.0f}°"
    assert family.at is not None, "the other coordinates have values"
    if varies is VariesWith.SPEED:
        along = amplitude.reshape(len(PATTERNS.speeds), -1)[:, 0]
        return f"by the speed, most near {1e3 * PATTERNS.speeds[np.argmax(np.abs(along))]:.0f} mm/s"
    at = family.at[np.argmax(np.abs(amplitude))]
    if varies is VariesWith.SIDE:
        return f"where the pusher touches the side towards {np.degrees(at[0]):.0f}° of the object's axes"
    if varies is VariesWith.TIME:
        return f"in each push in another way, about {_frequency(family.at, amplitude):.1f} times a second"
    return f"by the place on the table, most near ({1e3 * at[0]:.0f}, {1e3 * at[1]:.0f}) mm"


def _largest_heading(amplitude: Float64Array) -> float:
    """Angle at which the force of a function of it is largest [rad]; amplitudes of three components for each wave."""
    angles = np.radians(np.arange(-180.0, 180.0, 5.0))
    basis = waves(angles)
    force = basis @ amplitude.reshape(basis.shape[1], -1)
    return float(angles[np.argmax(np.sum(force**2, axis=1))])


def _frequency(at: Float64Array, amplitude: Float64Array) -> float:
    """Of the strongest oscillation of all pushes together [Hz], from amplitudes at times that are evenly spaced within each push."""
    candidates = np.arange(0.5, 6.25, 0.25)
    power = np.zeros(len(candidates))
    n_components = int(np.count_nonzero(np.all(at == at[0], axis=1)))
    for push in np.unique(at[:, 0]):
        of_push = at[:, 0] == push
        time = at[of_push, 1][::n_components]
        values = amplitude[of_push].reshape(-1, n_components)
        wave = np.exp(-2j * np.pi * candidates[:, None] * time)
        power += np.sum(np.abs(wave @ (values - values.mean(axis=0))) ** 2, axis=1) / len(time)
    return float(candidates[np.argmax(power)])
