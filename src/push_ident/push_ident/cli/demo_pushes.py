"""The pushes of the demo: each is planned, predicted, drawn and then made, and what the camera sees after it is compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from push_ident.cli.demo_picture import PushPicture, draw_pushes
from push_ident.cli.output import console, millimetres
from push_ident.errors import PushIdentError
from push_ident.identification.identify import uniform_model
from push_ident.identification.model_file import load_model
from push_ident.identification.prediction import cell_error, predict
from push_ident.identification.ways import Way, ways_of
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident.pushing.push import PushSettings
from push_ident.pushing.sampling import is_near_edge
from push_ident.types import Float64Array, PusherPath

if TYPE_CHECKING:
    from push_ident.nodes.client.cell_client import CellClient
    from push_ident_msgs.action import ExecutePush

__all__ = ["DemoPush", "DemoPushes"]

_OK: Final = 0
_NO_CONTACT: Final = -5
_MAX_REFUSALS: Final = 10
_DRAWS: Final = 10
"""Random pushes that are drawn for one: a tenth of a second each, where pushing an object back takes as long as a push."""
_LEARN: Final = 30.0
"""For a push to be learned [s]; a solve takes a second."""
_PHASES: Final = ("planning", "approach", "pushing, identifying", "rest", "retreat", "re-centring")


@dataclass(slots=True)
class DemoPush:
    """Errors of one push; NaN where nothing was known before it."""

    direction: float
    """[rad]"""
    distance: float
    """[m]"""
    speed: float
    """[m/s]"""
    moved_m: float = np.nan
    predicted_m: float = np.nan
    expected_m: float = np.nan
    uniform_m: float = np.nan
    """Mean displacement of the cells, their error as predicted, the error that was expected, and that of equal cells [m]."""
    ways: list[dict[str, Any]] = field(default_factory=list)
    """Ends that were predicted, each with its chance."""


class DemoPushes:
    """Makes pushes and keeps what came of them.

    Args:
        client: of the cell.
        object_id: of the object.
        seed: of the pushes.
        folder: of the picture and the model.
        show: called with what is done now, and the number of pushes that are newly done.
    """

    def __init__(self, client: CellClient, object_id: str, seed: int, folder: Path, show: Callable[[str, int], None]) -> None:
        from push_ident.nodes.client.camera_view import CameraView

        self._client, self._object_id, self._seed, self._folder, self._show = client, object_id, seed, folder, show
        self._camera = CameraView(client.node)
        self._pictures: list[PushPicture] = []
        self._refusals = 0
        self._asked = 0
        self._due = 0
        """Pushes that will be learned once identification has caught up."""
        self.made: list[DemoPush] = []

    def make(self, n: int) -> None:
        """Make random pushes, each predicted from those before it.

        Raises:
            PushIdentError: the cell does not answer, or one push after another could not be made.
        """
        done = 0
        while done < n:
            self._recentre()
            planned = self._planned()
            if planned is not None and self._push(planned):
                done += 1

    def _recentre(self) -> None:
        """Push an object near the edge of the workspace back: pushes are made as they were predicted, from where it lies."""
        from push_ident_msgs.action import ExecutePush

        if not is_near_edge(self._client.shape(self._object_id), self._at_rest(-np.inf), PushSettings()):
            return
        self._show("pushing it back to the middle", 0)
        known = self._n_learned()
        result = self._client.execute_push(ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RECENTRE, object_id=self._object_id))
        if result.error_code == _OK:
            # It is learned during the next push, which is predicted from the pushes before it.
            self._due = known + 1

    def _planned(self) -> ExecutePush.Result | None:
        """A random push that the arm can make, one that ends away from the edge if there is; None where the arm refused one."""
        first = None
        for _ in range(_DRAWS):
            planned = self._drawn()
            if planned is None or not self._ends_near_edge(planned):
                return planned
            first = first or planned
        return first

    def _drawn(self) -> ExecutePush.Result | None:
        """A random push that the arm can make; None where it refused this one."""
        from push_ident_msgs.action import ExecutePush

        seed = int(np.random.SeedSequence([self._seed, self._asked]).generate_state(1)[0])
        self._asked += 1
        goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=self._object_id, seed=seed, dry_run=True)
        result = self._client.execute_push(goal)
        if result.error_code != _OK:
            self._refused(result)
            return None
        return result

    def _ends_near_edge(self, planned: ExecutePush.Result) -> bool:
        """Whether the object, moved along a whole push, would have to be pushed back."""
        way = planned.distance * np.array([np.cos(planned.direction), np.sin(planned.direction), 0.0])
        return is_near_edge(self._client.shape(self._object_id), self._at_rest(-np.inf) + way, PushSettings())

    def _push(self, planned: ExecutePush.Result) -> bool:
        """Predict a planned push, make it and compare; whether it was made."""
        from push_ident.nodes.convert.model import pusher_path_from_msg
        from push_ident_msgs.action import ExecutePush

        client, object_id, number = self._client, self._object_id, len(self.made) + 1
        shape, before = client.shape(object_id), self._at_rest(-np.inf)
        push = DemoPush(planned.direction, planned.distance, planned.speed)
        picture = self._picture(before)
        path = pusher_path_from_msg(planned.tool_path, client.pusher_radius)
        predicted = self._predict(push, picture, path, before) if self._n_learned() else None
        self._draw()
        goal = ExecutePush.Goal(
            mode=ExecutePush.Goal.MODE_CONTACT,
            object_id=object_id,
            contact_point=planned.contact_point,
            direction=planned.direction,
            distance=planned.distance,
            speed=planned.speed,
        )
        known = max(self._n_learned(), self._due)
        result = client.execute_push(goal, on_feedback=lambda feedback: self._show(f"push {number}: {_PHASES[feedback.phase]}", 0))
        if result.error_code not in (_OK, _NO_CONTACT):
            self._pictures.pop()
            self._refused(result)
            return False
        after = self._at_rest(client.poses(object_id)[-1][0])
        push.moved_m = cell_error(shape.cells, before, after)
        if predicted is not None:
            push.predicted_m = cell_error(shape.cells, predicted, after)
            uniform = simulate(uniform_model(shape), PushScenario(path, before, path.time[-1:])).pose[-1]
            push.uniform_m = cell_error(shape.cells, uniform, after)
        picture.seen, picture.error_m = after, push.predicted_m
        self._draw()
        self.made.append(push)
        self._refusals = 0
        if result.error_code == _OK:
            self._learned(known + 1)
        self._show(f"push {number} is made", 1)
        self._say(number, push)
        return True

    def _predict(self, push: DemoPush, picture: PushPicture, path: PusherPath, before: Float64Array) -> Float64Array:
        """What the model of the node expects of a push: the last pose."""
        file = self._folder / "model.json"
        self._client.save_model(self._object_id, str(file.resolve()))
        _, posterior = load_model(file)
        found = predict(posterior, PushScenario(path, before, path.time))
        push.expected_m = picture.expected_m = found.cell_error_std
        # Where there is one way only, it is drawn where the mean model ends: that is the prediction.
        ways = ways_of(posterior.unknowns.shape.cells, found)
        picture.ways = ways if len(ways) > 1 else [Way(1.0, found.pose[-1])]
        push.ways = [{"chance": way.chance, "end": way.end.tolist()} for way in picture.ways]
        both = " or ".join(f"{way.chance:.0%}" for way in ways)
        unsure = f"; two ways it may end: {both}" if len(ways) > 1 else ""
        console.print(f"push {len(self.made) + 1} predicted, expected to {millimetres(found.cell_error_std)}{unsure}", highlight=False)
        return found.pose[-1]

    def _learned(self, n: int) -> None:
        """Wait until `n` pushes are learned; one that identification refused, such as for missing poses, is said and left."""
        from push_ident.nodes.client.cell_client import CellTimeout

        try:
            self._client.wait_for_map(self._object_id, n, _LEARN)
        except CellTimeout as error:
            self._due = 0
            console.print(f"the push was not learned: {error}", style="yellow", highlight=False, soft_wrap=True)

    def _n_learned(self) -> int:
        latest = self._client.latest_map(self._object_id)
        return 0 if latest is None else int(latest.n_pushes)

    def _at_rest(self, after: float) -> Float64Array:
        return self._client.pose_at_rest(self._object_id, after=after)

    def _picture(self, before: Float64Array) -> PushPicture:
        """Of the push that is next, with what the camera sees now."""
        view = self._camera
        missing = "no depth image, or no pose of the camera; is perception_node running?"
        self._client.wait(lambda: view.frame is not None and view.camera_in_table is not None, 20.0, missing)
        assert view.frame is not None and view.camera_in_table is not None
        outline = self._client.shape(self._object_id).outline
        self._pictures.append(PushPicture(view.frame, view.camera_in_table, before, outline))
        return self._pictures[-1]

    def _draw(self) -> None:
        draw_pushes(self._folder / "pushes.png", self._pictures, title="Each push is predicted from those before it, then made")

    def _say(self, number: int, push: DemoPush) -> None:
        travel = f"push {number}: travel {millimetres(push.moved_m)}"
        if np.isfinite(push.predicted_m):
            travel += f"; error of the prediction {millimetres(push.predicted_m)}, equal cells {millimetres(push.uniform_m)}"
        console.print(travel, highlight=False)

    def _refused(self, result: ExecutePush.Result) -> None:
        console.print(f"push not executed: {result.error_text}", style="yellow", highlight=False, soft_wrap=True)
        self._refusals += 1
        if self._refusals > _MAX_REFUSALS:
            raise PushIdentError(f"{self._refusals} pushes could not be executed; the last error: {result.error_text}")
