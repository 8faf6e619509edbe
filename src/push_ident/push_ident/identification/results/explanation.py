"""Whether a fit explains its own training pushes: against the observed motion, the stated noise, and what contact allows.

Student's t lets a fit call frames outliers, first poses included, and converge while every push ends elsewhere. So the outcome is judged
apart from its cost. Each training push is simulated from its first observed pose by the fitted model, and compared with three things:

- **Motion.** A model is of no use where the object ends further from its prediction than half of its own motion: "it does not move" is
  as good a prediction from twice that error on.
- **Noise.** An error within three standard deviations of the stated covariances counts as explained, however little the object moved.
- **Contact.** A pusher at rest cannot stay inside the object, and an object does not move before the pusher is near. Where the geometry is
  wrong (scale, unit, radius, frame), a fit may follow the motion all the same, by friction values that mean nothing.

A fit explains nothing where most pushes that moved are not explained, where its mean error is that of "it does not move", or where the
contacts are impossible in most pushes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from push_ident.geometry.cells import cell_error
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.identification.observing.observation import pusher_gaps, rest_frames
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.unknowns.mechanics import Mechanics
from push_ident.physics.effect_values import true_pose
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings
from push_ident.types import Float64Array, PushRecord, SolveStatus

_MOTION_SHARE: Final = 0.5
"""Error of an explained push, as a share of the motion [-]: above it, the model explains less of the motion than it leaves open."""
_DEVIATIONS: Final = 3.0
"""Standard deviations of the stated noise that an error, or an impossible contact, may have by chance: 0.3 % of normal errors."""
_CONTRADICTED_SHARE: Final = 0.5
"""Share of the pushes above which a contradiction is one of the fit, and not of single pushes, which a robust fit survives [-]."""
_OUTLINE_STD: Final = 2e-3
"""Standard deviation of an outline or a pusher's radius in use [m]: the prior of the effect that displaces the outline."""
_TOOL_STD: Final = 2e-3
"""Standard deviation of the tool tip in each direction of a calibrated cell [m]: the prior of the effect that displaces the tool."""
_MEDIAN: Final = np.pi / 2
"""Variance of a median over that of a mean, of many normal values [-]."""


_REST_FRAMES: Final = 5
"""Frames of which the median is the pose at rest, if they are at most a quarter of a push: one wrong pose does not move it."""


@dataclass(frozen=True, slots=True)
class PushEvidence:
    """What one training push shows about the fit."""

    error: float
    """Cell error of the fitted model at the end, from the first observed pose [m]; infinite where the simulation failed."""
    motion: float
    """Cell error of "the object does not move" [m]."""
    noise: float
    """Standard deviation of a cell error between two frames, by their stated covariances [m]."""
    overlap: float
    """Depth of the pusher inside the outline at the end of the push, both at rest [m]; negative: their gap."""
    remote_motion: float
    """Cell error between the first pose and the one when the pusher comes near [m]: motion without contact."""

    @property
    def moved(self) -> bool:
        """Whether the object moved by more than noise."""
        return self.motion > _DEVIATIONS * self.noise

    @property
    def is_overlapped(self) -> bool:
        """Whether the pusher ends inside the object, by more than the accuracy of poses, tool and outline allows."""
        return self.overlap > _near_distance(self.noise)

    @property
    def moved_untouched(self) -> bool:
        """Whether the object moved by more than noise before the pusher was near."""
        return self.remote_motion > _DEVIATIONS * self.noise

    @property
    def is_explained(self) -> bool:
        """Whether the model predicts the end of this push better than not at all."""
        return self.error <= max(_MOTION_SHARE * self.motion, _DEVIATIONS * self.noise)


@dataclass(frozen=True, slots=True)
class Explanation:
    """How well a fit explains its training pushes."""

    pushes: tuple[PushEvidence, ...] = ()
    """In the order of the records."""

    @property
    def unexplained(self) -> tuple[int, ...]:
        """Numbers of the training pushes, from 0, that the fit does not explain."""
        return tuple(i for i, push in enumerate(self.pushes) if not push.is_explained)

    @property
    def contradiction(self) -> str:
        """Why these pushes cannot be explained by any maps: impossible contacts, or ends no better predicted than by "it does not move"."""
        if impossible := self._impossible_contacts():
            return impossible
        moved = any(push.moved for push in self.pushes)
        # A push whose simulation fails is as good as not predicted: one of many does not condemn the fit of the others.
        error, motion = self._all("error"), self._all("motion")
        return self._missed() if moved and np.mean(np.where(np.isfinite(error), error, motion)) >= np.mean(motion) else ""

    @property
    def failure(self) -> str:
        """What makes this fit no success, with sizes and likely causes; empty where it explains its pushes."""
        missed = [not push.is_explained for push in self.pushes if push.moved]
        return self.contradiction or (self._missed() if sum(missed) > _CONTRADICTED_SHARE * len(missed) else "")

    def judged(self, status: SolveStatus, touched: bool) -> SolveStatus:
        """The status of a fit that ended with `status`, once its outcome is looked at; `touched`: whether any push touches the object."""
        if status is SolveStatus.SIMULATION_FAILED:
            return status
        if not touched:
            return SolveStatus.NO_CONTACT
        # A solve that was stopped early is no success as it is: a longer one may fit the pushes that it misses.
        ended = status in (SolveStatus.CONVERGED, SolveStatus.STALLED, SolveStatus.POOR_FIT)
        if self.contradiction or (ended and self.failure):
            return SolveStatus.UNEXPLAINED
        return SolveStatus.POOR_FIT if ended and self.unexplained else status

    def notes(self, sources: Sequence[str] = ()) -> list[str]:
        """Lines for people: why the fit is no success, or which pushes it leaves unexplained. `sources` names the pushes."""
        if self.failure:
            return [self.failure]
        names = list(sources) or [f"training push {i + 1}" for i in range(len(self.pushes))]
        return [
            f"{names[i] or f'training push {i + 1}'} is not explained: predicted {_mm(self.pushes[i].error)} from where it ended, "
            f"after a motion of {_mm(self.pushes[i].motion)}; look at its poses."
            for i in self.unexplained
        ]

    def _missed(self) -> str:
        error, motion = self._all("error"), self._all("motion")
        missed = [not push.is_explained for push in self.pushes if push.moved]
        return (
            f"The fit does not explain its own training pushes: it predicts their ends {_mm(np.median(error))} off (worst "
            f"{_mm(np.max(error))}), while the object moved {_mm(np.median(motion))}; {sum(missed)} of {len(missed)} pushes that moved "
            "it are missed by more than half of their motion. Likely causes: poses of another object or in wrong order, poses and pusher "
            "in different frames or units, clocks that differ, an outline or a pusher radius of another size. Look at one push in a viewer."
        )

    def _impossible_contacts(self) -> str:
        if not self.pushes:
            return ""
        n, noise = len(self.pushes), float(np.median(self._all("noise")))
        allowed = _DEVIATIONS * float(np.sqrt(_OUTLINE_STD**2 + _MEDIAN * (_TOOL_STD**2 + noise**2) / n))
        if (depth := float(np.median(self._all("overlap")))) > allowed:
            return (
                f"The contacts are impossible: at the end of a push the pusher rests {_mm(depth)} inside the object (median of {n} "
                f"pushes), where the accuracy of poses, tool and outline allows {_mm(allowed)}. Likely causes: an outline or a pusher "
                "radius that is too large, or poses and pusher in different frames. Measure object and pusher, check frames and units."
            )
        moved = [push for push in self.pushes if push.moved]
        inside = [push.overlap for push in moved if push.is_overlapped]
        remote = [push.remote_motion for push in moved if push.moved_untouched]
        impossible = [push for push in moved if push.is_overlapped or push.moved_untouched]
        if len(impossible) <= _CONTRADICTED_SHARE * len(moved):
            return ""
        kinds = ((inside, "the pusher at rest inside the object"), (remote, "motion of the object before the pusher is near"))
        reasons = [f"{len(values)} with {text} ({_mm(float(np.median(values)))})" for values, text in kinds if values]
        return (
            f"The contacts are impossible in {len(impossible)} of {len(moved)} pushes: {' and '.join(reasons)}. Likely causes: an "
            "outline or a pusher radius of another size, poses and pusher in different frames, or clocks that differ. Measure object and "
            "pusher, check frames, units and clocks."
        )

    def _all(self, name: str) -> Float64Array:
        return np.array([getattr(push, name) for push in self.pushes])


def explain(posterior: ModelPosterior, records: Sequence[PushRecord], *, settings: SimulationSettings | None = None) -> Explanation:
    """Compare the mean model of a fit with the pushes that it was fitted to, at least one."""
    mechanics = posterior.mean_mechanics
    return Explanation(tuple(_evidence(mechanics, record, settings) for record in records))


def _evidence(mechanics: Mechanics, record: PushRecord, settings: SimulationSettings | None) -> PushEvidence:
    poses, cells = record.poses, record.shape.cells
    n = max(1, min(_REST_FRAMES, len(poses.time) // 4))
    # An arm that hides the object in the middle of a push leaves few frames after it: those before it are no part of the end.
    _, after, touched = rest_frames(record)
    end = after[-n:] if touched else np.arange(len(poses.time))[-n:]
    first, last = np.median(poses.pose[:n], axis=0), np.median(poses.pose[end], axis=0)
    scenario = PushScenario(record.pusher, true_pose(mechanics.effects, first), poses.time[-1:], record.order)
    motion = mechanics.simulate(scenario, settings=settings)
    error = np.inf if motion.status is SolveStatus.SIMULATION_FAILED else cell_error(cells, motion.pose[-1], last)
    covariance = np.median(poses.covariance, axis=0)
    arm2 = float(np.mean(np.sum(cells.centres**2, axis=1)))
    noise = float(np.sqrt(2.0 * (covariance[0, 0] + covariance[1, 1] + arm2 * covariance[2, 2])))
    # An object that is hidden at the end of a push is last observed while it moves: compared is where the pusher was then.
    end_time, pusher = float(np.median(poses.time[end])), record.pusher
    tip = np.array([[np.interp(end_time, pusher.time, pusher.position[:, axis]) for axis in (0, 1)]])
    return PushEvidence(
        error=error if np.isfinite(error) else np.inf,
        motion=cell_error(cells, first, last),
        noise=noise,
        overlap=pusher.radius - _distance(record, tip, last)[0],
        remote_motion=_remote_motion(record, first, _near_distance(noise)),
    )


def _remote_motion(record: PushRecord, first: Float64Array, near: float) -> float:
    poses, pusher = record.poses, record.pusher
    # Of other tools than a cylinder the circle around them, so that no contact is missed.
    reach = pusher.shape.reach
    if len(poses.time) < 2 * _REST_FRAMES:
        # Too few frames to know when the object began to move; but it stood at its first pose until it was touched.
        came_near = _distance(record, pusher.position, first) < near + reach
        before = np.arange(0 if np.any(came_near) else len(poses.time))
    else:
        came_near = pusher_gaps(record) + pusher.radius - reach < near
        before = np.flatnonzero(poses.time < pusher.time[np.argmax(came_near)]) if np.any(came_near) else np.arange(len(poses.time))
    if not len(before):
        return 0.0
    return cell_error(record.shape.cells, first, np.median(poses.pose[before[-min(3, len(before)) :]], axis=0))


def _distance(record: PushRecord, points_in_table: Float64Array, pose_object_in_table: Float64Array) -> Float64Array:
    """Signed distance of points, shape (n, 2), from the outline of the object at a pose [m], shape (n,)."""
    return signed_distance(transform_points(inverse(pose_object_in_table), points_in_table), record.shape.outline)


def _near_distance(noise: float) -> float:
    """Gap above which the pusher cannot touch [m], where poses have this noise [m]."""
    return _DEVIATIONS * float(np.sqrt(_OUTLINE_STD**2 + _TOOL_STD**2 + noise**2))


def _mm(metres: float) -> str:
    """A length for people; metres where millimetres would be absurd."""
    if not np.isfinite(metres):
        return "without bounds"
    return f"{1e3 * metres:.1f} mm" if metres < 1.0 else f"{metres:.3g} m"
