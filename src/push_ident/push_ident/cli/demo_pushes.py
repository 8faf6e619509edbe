"""The pushes of the demo: each is planned, predicted and then made, and its end is compared with the prediction.

The list of them is the only one: console, report and JSON number and score these pushes, and the bag has the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from push_ident.cli.output import millimetres, say
from push_ident.errors import PushIdentError
from push_ident.geometry.cells import cell_error
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.predicting.prediction import Prediction, outcomes_of, predict
from push_ident.identification.predicting.scoring import PushScore
from push_ident.identification.results.model_file import load_model
from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.pushing.push import PushSettings
from push_ident.pushing.sampling import is_near_edge
from push_ident.types import Float64Array, PusherPath

if TYPE_CHECKING:
    from push_ident.nodes.client.cell_client import CellClient
    from push_ident_msgs.action import ExecutePush

_OK: Final = 0
_PHASES: Final = ("planning", "approach", "pushing, identifying", "rest", "retreat", "re-centring")
_RETREAT: Final = _PHASES.index("retreat")
"""Phase in which a push is made, and its record is published."""
_NO_CONTACT: Final = -5
"""Error of a push that moved nothing, which is known at its end."""


@dataclass(slots=True)
class DemoPush:
    """One push, its number from 1: direction [rad], distance [m], speed [m/s]; poses of the object (x, y, yaw), table frame [m, m, rad]."""

    number: int
    direction: float
    distance: float
    speed: float
    before: list[float]
    after: list[float] = field(default_factory=list)
    moved_m: float = np.nan
    predicted_m: float = np.nan
    expected_m: float = np.nan
    uniform_m: float = np.nan
    mahalanobis2: float = np.nan
    """Mean displacement of the cells; their error as predicted, as expected, and of equal cells [m]; squared Mahalanobis distance of the
    end from the prediction: NaN where nothing was known."""
    ways: list[dict[str, Any]] = field(default_factory=list)
    """Ends that were predicted, each with its chance, the likelier first."""

    def content(self) -> dict[str, Any]:
        """For JSON, without what was not predicted."""
        return {key: value for key, value in asdict(self).items() if not isinstance(value, float) or np.isfinite(value)}

    @property
    def score(self) -> PushScore:
        """How well it was predicted."""
        errors = (self.predicted_m, self.expected_m, self.mahalanobis2, self.uniform_m)
        return PushScore(self.number, f"push {self.number}", 0.0, *errors)

    @property
    def expectation(self) -> str:
        """What was predicted, for people."""
        ends = " or ".join(f"{way['chance']:.0%}" for way in self.ways)
        two = f"; two ways it may end: {ends}" if len(self.ways) > 1 else ""
        return f"expected to {millimetres(self.expected_m)}{two}" if self.ways else "nothing known yet"


class DemoPushes:
    """Makes pushes of an object and keeps what came of them; `show` is `rich.progress.Progress.update` of its task."""

    def __init__(self, client: CellClient, object_id: str, seed: int, model: Path, show: Callable[..., None]) -> None:
        self._client, self._object_id, self._seed, self._model, self._show = client, object_id, seed, model, show
        self._refusals = self._asked = 0
        self.made: list[DemoPush] = []

    def await_executor(self, patience: float = 30.0) -> None:
        """Wait until the executor knows the object and its arm answers. Raises PushIdentError where no push can be planned."""
        deadline = time.monotonic() + patience
        while (result := self._execute("RANDOM", dry_run=True)).error_code != _OK:
            if time.monotonic() > deadline:
                raise PushIdentError(f"no push can be planned {patience:.0f} s after the start: {result.error_text}")
            time.sleep(0.5)

    def make(self, n: int) -> list[DemoPush]:
        """Make pushes, each predicted from those before it. Raises PushIdentError where one after another could not be made.

        They are random; near the edge of the workspace, one back towards the middle.
        """
        first = len(self.made)
        while len(self.made) < first + n:
            if (planned := self._planned()) is not None:
                self._push(planned)
        return self.made[first:]

    def _execute(self, mode: str, on_feedback: Callable[[Any], None] | None = None, **goal: Any) -> ExecutePush.Result:
        from push_ident_msgs.action import ExecutePush

        message = ExecutePush.Goal(mode=getattr(ExecutePush.Goal, f"MODE_{mode}"), object_id=self._object_id, **goal)
        return self._client.execute_push(message, on_feedback=on_feedback)

    def _planned(self) -> ExecutePush.Result | None:
        """A push that the arm can make, random and one that ends away from the edge if there is; None where the arm refused one."""
        if self._is_near_edge(np.zeros(3)) and (planned := self._execute("RECENTRE", dry_run=True)).error_code == _OK:
            return planned
        first = None
        for _ in range(10):  # a tenth of a second each, where pushing an object back takes as long as a push
            seed = int(np.random.SeedSequence([self._seed, self._asked]).generate_state(1)[0])
            self._asked += 1
            planned = self._execute("RANDOM", seed=seed, dry_run=True)
            if planned.error_code != _OK:
                self._refused(planned)
                return None
            # The object, moved along the whole push, should not have to be pushed back.
            if not self._is_near_edge(planned.distance * np.array([np.cos(planned.direction), np.sin(planned.direction), 0.0])):
                return planned
            first = first or planned
        return first

    def _is_near_edge(self, motion: Float64Array) -> bool:
        """Whether the object is near the edge of the workspace after a motion (x, y, yaw)."""
        pose = self._client.pose_at_rest(self._object_id, after=-np.inf)
        return is_near_edge(self._client.shape(self._object_id), pose + motion, PushSettings())

    def _push(self, planned: ExecutePush.Result) -> None:
        from push_ident.nodes.convert.model import pusher_path_from_msg

        number, client, object_id = len(self.made) + 1, self._client, self._object_id
        shape, before = client.shape(object_id), client.pose_at_rest(object_id, after=-np.inf)
        push = DemoPush(number, planned.direction, planned.distance, planned.speed, before.tolist())
        assert client.tool is not None, "its executor has planned"
        path = pusher_path_from_msg(planned.tool_path, client.tool)
        predicted = self._predict(push, path, before) if self._n_learned() else None
        known = self._n_learned()
        plan = {name: getattr(planned, name) for name in ("contact_point", "direction", "distance", "speed")}
        phases = [0]

        def follow(feedback: ExecutePush.Feedback) -> None:
            phases.append(int(feedback.phase))
            self._show(description=f"push {number}: {_PHASES[feedback.phase]}")

        result = self._execute("CONTACT", follow, **plan)
        if result.error_code != _OK:
            if _RETREAT not in phases or result.error_code == _NO_CONTACT:
                self._refused(result)
                return
            # The push was made, recorded and learned; the arm was held on its way back.
            say(f"push {number} is made, then: {result.error_text}", style="yellow")
        after = client.pose_at_rest(object_id, after=client.poses(object_id)[-1][0])
        push.after, push.moved_m = after.tolist(), cell_error(shape.cells, before, after)
        text = f"push {number}: travel {millimetres(push.moved_m)}"
        if predicted is not None:
            uniform = simulate(uniform_model(shape), PushScenario(path, before, path.time[-1:])).pose[-1]
            end = predicted.pose[-1]
            push.predicted_m, push.uniform_m = (cell_error(shape.cells, pose, after) for pose in (end, uniform))
            apart = np.append(after[:2] - end[:2], wrap_angle(after[2] - end[2]))
            push.mahalanobis2 = float(apart @ np.linalg.solve(predicted.covariance[-1] + NoiseModel().floor, apart))
            text += f"; error of the prediction {millimetres(push.predicted_m)}, equal cells {millimetres(push.uniform_m)}"
        self.made.append(push)
        self._refusals = 0
        self._learned(known + 1)
        self._show(description=f"push {number} is made", advance=1)
        say(text)

    def _predict(self, push: DemoPush, path: PusherPath, before: Float64Array) -> Prediction:
        self._client.save_model(self._object_id, str(self._model.resolve()))
        _, posterior = load_model(self._model)
        prediction = predict(posterior, PushScenario(path, before, path.time))
        outcomes = outcomes_of(posterior.unknowns.shape.cells, prediction)
        push.expected_m = prediction.cell_error_std
        push.ways = [{"chance": outcome.chance, "end": outcome.end.tolist()} for outcome in outcomes]
        say(f"push {len(self.made) + 1} predicted, {push.expectation}")
        return prediction

    def _learned(self, n: int) -> None:
        """Wait until `n` pushes are learned; one that identification refused, such as for missing poses, is said and left."""
        from push_ident.nodes.client.cell_client import CellTimeout

        try:
            self._client.wait_for_map(self._object_id, n, 30.0)  # a solve takes a second
        except CellTimeout as error:
            say(f"the push was not learned: {error}", style="yellow")

    def _n_learned(self) -> int:
        latest = self._client.latest_map(self._object_id)
        return 0 if latest is None else int(latest.n_pushes)

    def _refused(self, result: ExecutePush.Result) -> None:
        say(f"push not executed: {result.error_text}", style="yellow")
        self._refusals += 1
        if self._refusals > 10:
            raise PushIdentError(f"{self._refusals} pushes could not be executed; the last error: {result.error_text}")
        # The arm may have hidden the object: there is no next push before it is seen anew.
        self._client.pose_at_rest(self._object_id, after=self._client.poses(self._object_id)[-1][0])
