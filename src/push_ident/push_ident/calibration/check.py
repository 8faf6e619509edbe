"""Does the calibration of a cell agree with the contacts of its pushes, how wrong may it be, and which push would show more?

For each quantity the contacts alone are compared with what is configured, at the accuracy that is stated for it. What is stated of the
others counts as knowledge, so that few pushes are enough, until the contacts contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import product
from typing import Final

import numpy as np
from scipy.special import ndtr

from push_ident.calibration.contacts import N_UNKNOWNS, Contacts, contacts_of, gaps_of
from push_ident.calibration.estimate import NOTHING, Estimate, estimate
from push_ident.checking.contact import contact_tolerance_of
from push_ident.checking.records import check_records
from push_ident.errors import InputError
from push_ident.geometry.se2 import rotation
from push_ident.perception.settings import PerceptionSettings
from push_ident.types import CameraAccuracy, Float64Array, PusherPath, PushRecord

ODDS: Final = 0.05
"""Share of right calibrations with which something is said to differ; shared out among the quantities (Bonferroni)."""
NAMES: Final = ("camera_x", "camera_y", "camera_heading", "surface", "clock")
"""Of the unknowns, in their order."""
UNITS: Final = ("m", "m", "rad", "m", "s")
_CAMERA: Final = slice(0, 3)
_USUAL: Final = PerceptionSettings().camera_accuracy
_NEEDED: Final = np.array([_USUAL.position, _USUAL.position, _USUAL.heading, 1e-3, 1e-2])
"""Standard deviations that count as known where none is stated: those of a camera that is calibrated by hand; 1 mm of the surface, and the
clock with which a tool at 100 mm/s goes as far."""
_FURTHER: Final = 0.15
"""By which the next push is looked for beside those that were made, along each axis [m]: the radius of usual objects and more."""


class Outcome(Enum):
    """Of one quantity; the value says it in words."""

    AGREES = "agrees"
    DIFFERS = "differs"
    UNKNOWN = "not shown"


class Verdict(Enum):
    """Of all of them."""

    AGREES = "agrees"
    DIFFERS = "differs"
    NOT_ENOUGH = "not_enough"


@dataclass(frozen=True, slots=True)
class Quantity:
    """An error of the calibration; all are zero where it is right."""

    name: str
    unit: str
    estimate: float
    """What the contacts show, without what is stated of it."""
    std: float
    stated_std: float
    """Standard deviation that is stated of it; 0: none is."""
    needed_std: float
    """Standard deviation from which on it counts as known: the stated one, or a usual one."""
    probability: float
    """That a right calibration shows this much or more."""
    outcome: Outcome

    @property
    def deviations(self) -> float:
        """Estimate over what it and the stated accuracy explain together [-]."""
        return self.estimate / float(np.hypot(self.std, self.stated_std))


@dataclass(frozen=True, slots=True)
class NextPush:
    """The contact that would show most of what is not known yet."""

    towards: Float64Array
    """Direction of the tool, unit vector, table frame, shape (2,)."""
    place: Float64Array
    """Of the contact in `table` [m], shape (2,)."""
    speed: float
    """[m/s]"""
    name: str
    """The quantity that is known worst, by what is needed."""
    std: float
    """Its standard deviation now."""
    std_after: float
    """Expected after such a push."""


@dataclass(frozen=True, slots=True)
class CalibrationCheck:
    """What pushes show of the calibration of their cell."""

    quantities: tuple[Quantity, ...]
    """In the order of `NAMES`, without a clock that no frame shows."""
    unknowns: Float64Array
    """All that is known together, what is stated included, unless the contacts contradict it [m, m, rad, m, s], shape (5,)."""
    covariance: Float64Array
    """Of these, shape (5, 5)."""
    contacts: tuple[Contacts, ...]
    n_pushes: int
    """With those that show no contact."""
    next_push: NextPush | None
    """None where everything is known."""
    warnings: tuple[str, ...]
    """What is wrong with the pushes beside these errors."""

    @property
    def verdict(self) -> Verdict:
        """`DIFFERS` where any quantity does; `NOT_ENOUGH` where the contacts show less of the camera than what is stated of it."""
        if any(quantity.outcome is Outcome.DIFFERS for quantity in self.quantities):
            return Verdict.DIFFERS
        if any(quantity.outcome is Outcome.UNKNOWN for quantity in self.quantities[_CAMERA]):
            return Verdict.NOT_ENOUGH
        return Verdict.AGREES

    @property
    def centre(self) -> Float64Array:
        """Middle of the contacts in `table` [m], shape (2,), where camera and tool are compared."""
        return self.contacts[0].centre

    def corrected(self, camera_in_table: Float64Array) -> tuple[Float64Array, CameraAccuracy]:
        """The camera's pose, shape (4, 4), that agrees with the contacts, and how well it is known; from the one that was in use."""
        x, y, heading = self.unknowns[_CAMERA]
        error = np.eye(4)
        error[:2, :2] = rotation(heading)
        error[:2, 3] = self.centre - rotation(heading) @ self.centre + [x, y]
        at_origin = np.array([[1.0, 0.0, self.centre[1]], [0.0, 1.0, -self.centre[0]]])
        of_origin = at_origin @ self.covariance[_CAMERA, _CAMERA] @ at_origin.T
        accuracy = CameraAccuracy(position=float(np.sqrt(0.5 * np.trace(of_origin))), heading=float(np.sqrt(self.covariance[2, 2])))
        return np.linalg.inv(error) @ camera_in_table, accuracy


def check_calibration(records: Sequence[PushRecord]) -> CalibrationCheck:
    """Check the calibration with which pushes of one object were recorded.

    Raises InputError where no push shows a contact, or the tool is no cylinder.
    """
    contacts = contacts_of(records)
    if not contacts:
        raise InputError(f"none of {len(records)} pushes shows a contact: no frame shows an object in motion, or at rest against the tool.")
    stated = stated_std(contacts)
    prior = np.where(stated > 0.0, stated, NOTHING)
    while True:
        found = estimate(contacts, prior)
        quantities = _quantities(contacts, found, prior, stated)
        differing = [quantity.name for quantity in quantities if quantity.outcome is Outcome.DIFFERS]
        contradicted = np.isin(NAMES, differing) & (prior < NOTHING)
        if not np.any(contradicted):
            break
        prior = np.where(contradicted, NOTHING, prior)
    warnings: tuple[str, ...] = ()
    if not (found.converged and _meet(contacts, found)):
        quantities = tuple(replace(quantity, outcome=Outcome.UNKNOWN) for quantity in quantities)
        # A wrong unit, axis or frame is named there.
        warnings = check_records(records).warnings or ("no calibration brings tool and outline together in all pushes.",)
    open_ones = [quantity for quantity in quantities if quantity.std > quantity.needed_std]
    following = _next_push(contacts, found, open_ones) if open_ones else None
    return CalibrationCheck(quantities, found.unknowns, found.covariance, tuple(contacts), len(records), following, warnings)


def _meet(contacts: Sequence[Contacts], found: Estimate) -> bool:
    """Whether tool and outline are together, but for noise, in 95 % of the frames: one of three deviations holds for more."""
    gaps = np.concatenate([gaps_of(one, found.unknowns).gap for one in contacts])
    return float(np.mean(np.abs(gaps) < contact_tolerance_of([one.record for one in contacts]))) >= 0.95


def stated_std(contacts: Sequence[Contacts]) -> Float64Array:
    """What is stated of each unknown, shape (5,); 0: nothing is.

    The camera's accuracy and that of the outline come with the pushes: that of its place holds at the origin of `table`. A pose is stamped
    somewhere within the time of its frame.
    """
    first = contacts[0].record
    camera, arm = first.poses.camera, contacts[0].centre
    frame = float(np.median(np.concatenate([np.diff(one.record.poses.time) for one in contacts])))
    x, y = np.hypot(camera.position, camera.heading * arm[::-1])
    return np.array([x, y, camera.heading, first.shape.outline_error or 0.0, frame / np.sqrt(12.0)])


def _quantities(contacts: Sequence[Contacts], found: Estimate, prior: Float64Array, stated: Float64Array) -> tuple[Quantity, ...]:
    quantities = []
    for k in _shown(contacts):
        variance = float(found.covariance[k, k])
        # Without its own prior: Gaussian densities divide.
        information = max(1.0 / variance - 1.0 / float(prior[k]) ** 2, 1e-3 / float(NOTHING[k]) ** 2)
        value, std = float(found.unknowns[k]) / (variance * information), float(np.sqrt(1.0 / information))
        needed = float(stated[k]) or float(_NEEDED[k])
        probability = float(2.0 * ndtr(-abs(value) / np.hypot(std, stated[k])))
        if found.converged and probability < ODDS / N_UNKNOWNS:
            outcome = Outcome.DIFFERS
        else:
            outcome = Outcome.AGREES if std <= needed else Outcome.UNKNOWN
        quantities.append(Quantity(NAMES[k], UNITS[k], value, std, float(stated[k]), needed, probability, outcome))
    return tuple(quantities)


def _next_push(contacts: Sequence[Contacts], found: Estimate, unknown: Sequence[Quantity]) -> NextPush:
    """Of pushes in eight directions, at and beside the places of those that were made, at their speed and at half of it."""
    centre = contacts[0].centre
    speed = float(np.median([np.max(_speed(one.record.pusher)) for one in contacts]))
    at = [NAMES.index(quantity.name) for quantity in unknown]
    needed = np.array([quantity.needed_std for quantity in unknown])
    worst = int(np.argmax(np.diag(found.covariance)[at] / needed**2))
    now = float(np.sqrt(found.covariance[at[worst], at[worst]]))
    pushes = []
    for side, x, y, share in product(range(8), (0.0, -_FURTHER, _FURTHER), (0.0, -_FURTHER, _FURTHER), (1.0, 0.5)):
        outward = -np.array([np.cos(side * np.pi / 4), np.sin(side * np.pi / 4)])
        row = np.array([*outward, x * outward[1] - y * outward[0], -1.0, share * speed])
        seen = found.covariance @ row
        after = (np.diag(found.covariance) - seen**2 / (found.contact_variance + float(row @ seen)))[at]
        push = NextPush(-outward, np.add(centre, (x, y)), share * speed, unknown[worst].name, now, float(np.sqrt(after[worst])))
        pushes.append((float(np.sum(after / needed**2)), push))
    return min(pushes, key=lambda one: one[0])[1]


def _shown(contacts: Sequence[Contacts]) -> range:
    """The unknowns that the pushes can show at all: no clock where only rests were seen."""
    return range(N_UNKNOWNS if any(np.any(one.moves) for one in contacts) else N_UNKNOWNS - 1)


def _speed(path: PusherPath) -> Float64Array:
    return np.asarray(np.linalg.norm(np.diff(path.position, axis=0), axis=1) / np.diff(path.time))
