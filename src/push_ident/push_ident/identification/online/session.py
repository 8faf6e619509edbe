"""One object during its pushes: estimate, predictions, their scores, and the file that survives a killed process."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from push_ident.errors import InputError, PlanningError
from push_ident.geometry.cut_cells import cut_at_outline
from push_ident.identification.observing.observation import NoiseModel, observe_push
from push_ident.identification.online.identifier import FrameUpdate, OnlineIdentifier, OnlineState
from push_ident.identification.online.state_file import load_state, save_state
from push_ident.identification.predicting.next_push import (
    PlannedPush,
    RankingOptions,
    UnwantedError,
    candidate_pushes,
    rank_pushes,
    reference_pushes,
)
from push_ident.identification.predicting.possible_poses import CheckedPoses, ImpossiblePosesError, check_poses, why_no_object_ends_there
from push_ident.identification.predicting.prediction import Prediction, predict
from push_ident.identification.predicting.scoring import PushScore, RunningRecord, score_push
from push_ident.identification.results.known_effects import KnownEffect, check_agreement, effects_in_use
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.identification.solvers import DEFAULT_SOLVER, solver_of
from push_ident.identification.unknowns.prior import Prior
from push_ident.physics.scenario import PushScenario
from push_ident.pushing.push import PushSettings
from push_ident.types import CellGrid, Float64Array, ObjectShape, PusherPath, PushRecord, SolveStatus

_Key = tuple[float, float, float]
REMEMBERED_PUSHES = 10_000
"""Number of the latest pushes that are recognised when they arrive again: memory must not grow with the pushes."""


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """How objects are identified online."""

    prior: Prior = field(default_factory=Prior)
    method: str = DEFAULT_SOLVER
    window: int = 8
    """Pushes simulated again at every solve."""
    max_seconds: float = 10.0
    """Of the solve after a push [s]."""
    frame_seconds: float = 0.02
    """Of an update at a frame, for methods whose update has no bound of its own [s]."""
    noise: NoiseModel | None = None
    folder: Path | None = None
    """Folder of the states of all objects; None: they are not kept."""


class ObjectSession:
    """The estimate of one object, kept on disk after every push; its id is part of the file name.

    Raises:
        ModelFileError: a file of this object exists but cannot be used, or the state cannot be written.
    """

    def __init__(self, object_id: str, shape: ObjectShape, options: SessionOptions) -> None:
        self.object_id = object_id
        self.options = options
        self.sources: list[str] = []
        """Names of the latest pushes."""
        self.record = RunningRecord()
        self.checked: CheckedPoses | None = None
        """What of the latest finished push is possible."""
        self.n_known_again = 0
        """Number of pushes that arrived a second time (a bag played in a loop, or again after a killed process) and were ignored."""
        self._known: deque[_Key] = deque(maxlen=REMEMBERED_PUSHES)
        state = OnlineIdentifier.new(shape, options.prior)
        self.restored = False
        """Whether the estimate continues from a file."""
        if self.file is not None and self.file.exists():
            kept = load_state(self.file)
            if kept.state.shape.is_same_object(shape):
                state, self.restored = kept.state, True
                self.sources, self.record = list(kept.sources), kept.record
                self._known.extend(kept.pushes)
            else:
                self._rename_file()
        self.online = self._identifier(state)

    @property
    def file(self) -> Path | None:
        """File of the state."""
        return None if self.options.folder is None else self.options.folder / f"{self.object_id}.state.json"

    @property
    def shape(self) -> ObjectShape:
        """Outline and cells of the object."""
        return self.online.state.shape

    @property
    def posterior(self) -> ModelPosterior:
        """The latest estimate, in the middle of a push too."""
        return self.online.posterior

    @property
    def status(self) -> SolveStatus | None:
        """Of the solve after the last push; None before the first."""
        return self.online.state.status

    @property
    def failure(self) -> str:
        """Why the latest solve is no success, although it ended; empty where it explains its pushes."""
        result = self.online.result
        return result.explanation.failure if result is not None and result.status is SolveStatus.UNEXPLAINED else ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with the latest pushes, whatever the status says."""
        return self.online.result.warnings if self.online.result is not None else ()

    @property
    def n_pushes(self) -> int:
        """Number of finished pushes in the estimate."""
        return self.online.n_pushes

    @property
    def is_new(self) -> bool:
        """Whether nothing is known of the object but its shape."""
        return not self.online.state.records and self.online.state.past is None

    def refine_shape(self, shape: ObjectShape) -> bool:
        """Take a better outline of the same object; whether its pushes were fitted again with it.

        Squares of cells and unknowns stay: an outline with deviations takes the place of one with deviations. Once older pushes are summed
        up, the outline stays as well, since they have shown how far it is off. Before the first push any shape of the object is taken, such
        as the one with its outline after its cells.

        Raises:
            ModelFileError: the state cannot be written. The estimate has changed nevertheless.
        """
        before, state = self.shape, self.online.state
        if self.is_new:
            fresh = OnlineIdentifier.new(shape, self.options.prior)
            self.online = self._identifier(OnlineIdentifier.with_effects(fresh, state.known) if state.known else fresh)
            return False
        if (before.outline_std is None) != (shape.outline_std is None) or state.past is not None:
            return False
        if all(np.array_equal(getattr(before, name), getattr(shape, name)) for name in ("outline", "outline_std")):
            return False
        self.online.refine(cut_at_outline(replace(shape, cells=CellGrid(before.cells.squares, before.cells.size))))
        self.save()
        return True

    def use_effects(self, effects: Sequence[KnownEffect], *, n_pushes: int, until: float = np.inf, keep: Collection[str] = ()) -> None:
        """Fit these effects with the maps from now on, and no others but errors of sensors and those to `keep`.

        The latest pushes are fitted anew; older ones, which were summed up without these effects, count no more. An error of a sensor that
        is an unknown already stays what it is. `n_pushes`: behind the values of the effects; `until`: end of the last of them [s], pushes
        of the model that ended later are not among them.

        Raises:
            InputError: the solver fits no effects, or the pushes of the model contradict these. The estimate stays what it was.
            ModelFileError: the state cannot be written. The estimate has changed nevertheless.
        """
        if not solver_of(self.options.method).capabilities.takes_effects:
            raise InputError(f"`{self.options.method}` fits no effects; set the parameter `method` to {DEFAULT_SOLVER}.")
        state = self.online.state
        # Stamps are rounded where they become numbers.
        shared = sum(float(record.poses.time[-1]) <= until + 1e-6 for record in state.records)
        in_use = {effect.name: effect for effect in effects_in_use(state.posterior)}
        measured = set(state.posterior.effects.names) - set(in_use)
        share = max(0.0, 1.0 - shared / n_pushes)
        taken = [replace(effect, share=share) for effect in effects if effect.name not in measured]
        before = {name: replace(effect, share=0.0) for name, effect in in_use.items()} | {effect.name: effect for effect in state.known}
        kept = [effect for name, effect in before.items() if name in keep and name not in {effect.name for effect in taken}]
        if not taken and len(kept) == len(in_use):
            return
        online = self._identifier(OnlineIdentifier.with_effects(state, [*taken, *kept]))
        result = online.solve_again()
        if result is not None:
            if result.status.is_failure:
                names = ", ".join(effect.name for effect in (*taken, *kept)) or "no effect"
                raise InputError(f"With {names} the pushes of `{self.object_id}` are not fitted: {result.status.value}.")
            check_agreement(online.posterior, taken)
        self.online = online
        self.save()

    def knows(self, record: PushRecord) -> bool:
        """Whether this push is in the estimate already."""
        return _key(record) in self._known

    def update(self, partial: PushRecord) -> FrameUpdate | None:
        """Estimate from the push so far; None before contact, where the push is known already, and while poses contradict each other."""
        checked = check_poses(partial)
        return None if self.knows(partial) or checked.why else self.online.update(checked.record)

    def drop_update(self) -> bool:
        """Forget what was estimated from a push that is not finished; whether there was anything."""
        return self.online.drop_update()

    def finish(self, record: PushRecord) -> PushScore | None:
        """Score the prediction of a finished push, add the push to the estimate, and keep the state; None where it adds nothing.

        Poses that no push can have made are left out; see `checked`.

        Raises:
            ImpossiblePosesError: no push can have made its poses.
            ModelFileError: the state cannot be written. The estimate has changed nevertheless.
        """
        self.checked = None
        if self.knows(record):
            self.n_known_again += 1
            self.drop_update()
            return None
        self.checked = checked = check_poses(record)
        record, why = checked.record, checked.why
        if not why:
            if not observe_push(record, self.options.noise).touched:
                self.drop_update()
                return None
            why = why_no_object_ends_there(record, self.online.state.posterior, self.online.state.prior)
        if why:
            self.drop_update()
            raise ImpossiblePosesError(f"no push can have made its poses: {why}")
        records = self.online.state.records
        # Pushes that count no more were made all the same.
        record = replace(record, order=max(self.n_pushes, records[-1].order + 1 if records else 0))
        score = score_push(self.online.state.posterior, record, self.n_pushes + 1, noise=self.options.noise)
        result = self.online.add(record)
        score = replace(score, explained=result.explanation.pushes[-1].is_explained and result.status is not SolveStatus.UNEXPLAINED)
        self._known.append(_key(record))
        self.record = self.record.add(score)
        self.sources = [*self.sources, record.source][-200:]
        self.save()
        return score

    def adopt(self, posterior: ModelPosterior, source: str) -> None:
        """Adopt another model of the object; further pushes add to it.

        Raises:
            InputError: the model belongs to an object of another shape.
        """
        if not posterior.unknowns.shape.is_same_object(self.shape):
            raise InputError(
                f"The model is of another object: {len(posterior.unknowns.shape.cells)} cells, expected the outline and the cells of "
                f"`{self.object_id}` with {len(self.shape.cells)}; load it for the object that it was made of."
            )
        self.online = self._identifier(OnlineIdentifier.known(posterior))
        self.sources, self.record = [source], RunningRecord()
        self._known.clear()
        self.save()

    def save(self) -> None:
        """Keep the state; the file on disk is complete at any moment."""
        if self.file is not None:
            online, known = self.online, tuple(self._known)
            save_state(self.file, online.state, object_id=self.object_id, sources=self.sources, record=self.record, pushes=known)

    def predict_under_way(self, partial: PushRecord, horizon: float) -> Prediction:
        """Motion of the object during the next `horizon` seconds if the pusher keeps its velocity; by few models, since others follow."""
        observed, noise = observe_push(partial, self.options.noise), self.options.noise
        now = float(partial.pusher.time[-1])
        scenario = PushScenario(_continued(partial.pusher, horizon), observed.pose[0], np.linspace(now, now + horizon, 11))
        return predict(self.posterior, scenario, first_covariance=observed.first_covariance, noise=noise, n_samples=12)

    def suggest(
        self,
        pose: Float64Array,
        push_settings: PushSettings,
        obstacles: Sequence[Float64Array] = (),
        *,
        n_candidates: int = 24,
        n_references: int = 12,
        is_wanted: Callable[[], bool] = lambda: True,
    ) -> tuple[PlannedPush, Prediction] | None:
        """The push to make next, with its prediction; None where no safe push would add information, or it is no longer wanted.

        `pose`: of the object now, table frame, shape (3,); `obstacles`: outlines of other objects, table frame [m], each of shape
        (n_vertices, 2); `n_references`: pushes that are to be predicted well; `is_wanted`: asked before each simulation.
        """
        rng = np.random.default_rng(self.n_pushes)
        try:
            candidates = candidate_pushes(self.shape, pose, rng, n_candidates, push_settings, obstacles)
        except PlanningError:
            return None
        reference = reference_pushes(self.shape, rng, n_references, push_settings)
        options = RankingOptions(noise=self.options.noise)
        try:
            best = rank_pushes(self.posterior, candidates, reference=reference, rng=rng, options=options, is_wanted=is_wanted).best
        except UnwantedError:
            return None
        if best is None:
            return None
        time = np.linspace(best.pusher.time[0], best.pusher.time[-1], 31)
        return best, predict(self.posterior, PushScenario(best.pusher, best.pose_object_in_table, time), noise=self.options.noise)

    def replaced_by(self, shape: ObjectShape) -> ObjectSession:
        """Session of another object with the same id; the state of this one is renamed on disk."""
        self._rename_file()
        return ObjectSession(self.object_id, shape, self.options)

    def _rename_file(self) -> None:
        if self.file is not None and self.file.exists():
            n = 1
            while (aside := self.file.with_name(f"{self.object_id}-before-{n}.state.json")).exists():
                n += 1
            self.file.replace(aside)

    def _identifier(self, state: OnlineState) -> OnlineIdentifier:
        options = self.options
        return OnlineIdentifier(
            state,
            noise=options.noise,
            method=options.method,
            window=options.window,
            max_seconds=options.max_seconds,
            frame_seconds=options.frame_seconds,
        )


def _key(record: PushRecord) -> _Key:
    """Identity of a push: when and where it began."""
    time, (x, y) = record.pusher.time[0], record.pusher.position[0]
    return round(float(time), 6), round(float(x), 6), round(float(y), 6)


def _continued(pusher: PusherPath, horizon: float) -> PusherPath:
    """The path so far, continued at its mean velocity over the last tenth of a second."""
    end = float(pusher.time[-1])
    since = max(float(pusher.time[0]), end - 0.1)
    start = np.array([np.interp(since, pusher.time, pusher.position[:, axis]) for axis in (0, 1)])
    velocity = (pusher.position[-1] - start) / max(end - since, 1e-6)
    time = np.append(pusher.time, end + horizon)
    return PusherPath(time, np.vstack([pusher.position, pusher.position[-1] + horizon * velocity]), pusher.radius)
