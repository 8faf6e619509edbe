"""goal_pushing_node while it is fuzzed: an object with a model, and no executor, so that nothing moves and a goal can be there already."""

from __future__ import annotations

from typing import Any, ClassVar, Final

import numpy as np
from geometry_msgs.msg import Point, PoseStamped

from push_ident.identification.results.posterior import prior_posterior
from push_ident.nodes.convert.messages import TABLE_FRAME, planar_pose_to_msg, shape_from_msgs, stamp_to_msg
from push_ident.nodes.convert.model import posterior_to_msg
from push_ident.nodes.goal_pushing.convert_goal import planar_pose_msg
from push_ident_msgs.action import PushToGoal
from push_ident_msgs.msg import ModelPosterior
from push_ident_sim.fuzz.bench import Bench
from push_ident_sim.fuzz.scenes import Pushes
from push_ident_sim.fuzz.traffic import OBJECT, shape_messages, table_messages

__all__ = ["GoalPushing"]

_POSES: Final = 8
"""At rest before a goal: more than the three in a row from which the node believes a jump of time."""
_RATE: Final = 30.0
"""Of the poses [1/s]."""
_PATIENCE: Final = 40.0
"""For a valid goal [s], as granted: one that a mutated goal began looks for an executor for 5 s, and for the object as long again."""


class GoalPushing(Pushes):
    """The object lies at a goal: that is noticed after whatever was sent before."""

    own_parameters: ClassVar[dict[str, object]] = {"object_patience": 5.0, "learn_timeout": 1.0, "time_limit": 10.0}

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        self._stamp = 0.0

    def prepare(self) -> None:
        """Also the model and the table."""
        super().prepare()
        for topic, own in table_messages():
            self.keep(topic, own)
        (_, cells), (_, outline), _ = shape_messages()
        posterior = prior_posterior(shape_from_msgs(cells, outline))
        msg: ModelPosterior = posterior_to_msg(posterior, OBJECT, stamp_to_msg(1.0), n_pushes=1, is_known=True)
        self.keep(f"/objects/{OBJECT}/model", msg)

    def requests(self, service: str) -> list[Any]:
        """A goal of each kind."""
        goals = (self._pose(), self._path(), self._edge())
        return [self._request(goal) for goal in goals] if service == "/push_to_goal/_action/send_goal" else []

    def work(self) -> None:
        """A goal where the object lies, and a path that ends there, are reached without a push."""
        for _ in range(int(_PATIENCE)):
            # A node that was cleaned up looks for objects again, once a second.
            self.settle()
            self.rest()
            if self.bench.await_report(
                lambda values: values.get("objects") == OBJECT and OBJECT in values["pushes learned by object"], 1.5
            ):
                break
        for goal in (self._pose(), self._path()):
            self._reach(goal)

    def _reach(self, goal: PushToGoal.Goal) -> None:
        self.rest()
        request, service = self._request(goal), self.bench.kind_of("push_ident_msgs/action/PushToGoal_SendGoal")
        answer = self.bench.attempt("/push_to_goal/_action/send_goal", service, request)
        self.require(answer is not None and answer.accepted, "a valid goal was not accepted")
        kind = self.bench.kind_of("push_ident_msgs/action/PushToGoal_GetResult")
        future = self.bench.ask("/push_to_goal/_action/get_result", kind, kind.Request(goal_id=request.goal_id))
        for _ in range(int(_PATIENCE)):
            if self.bench.wait(future.done, 0.5):
                break
            self.rest()  # a pose that is too old is none
        self.require(future.done(), f"a valid goal did not end within {_PATIENCE:.0f} s")
        result = future.result().result
        reached = result.error_code == 0 and result.pushes == 0
        self.require(reached, f"the object lies at the goal, and the node says {result.error_code}: {result.error_text}")

    def rest(self) -> None:
        """Poses of the object at the origin."""
        self._start = self._stamp = max(self._start, self._stamp) + 1.0
        for _ in range(_POSES):
            self._stamp += 1.0 / _RATE
            self.send(f"/objects/{OBJECT}/pose", planar_pose_to_msg(stamp_to_msg(self._stamp), np.zeros(3), 1e-6 * np.eye(3)))
            self.bench.spin(1.0 / _RATE)

    @staticmethod
    def _pose() -> PushToGoal.Goal:
        goal = PushToGoal.Goal(object_id=OBJECT)
        goal.goal.header.frame_id = TABLE_FRAME
        return goal

    @staticmethod
    def _path() -> PushToGoal.Goal:
        goal = PushToGoal.Goal(kind=PushToGoal.Goal.KIND_PATH, object_id=OBJECT, speed=0.05)
        goal.path.header.frame_id = TABLE_FRAME
        goal.path.poses = [PoseStamped(pose=planar_pose_msg(np.array([0.0, y, 0.0]))) for y in (-0.06, -0.02, 0.0)]
        return goal

    @staticmethod
    def _edge() -> PushToGoal.Goal:
        ends = [Point(x=0.15, y=-0.3), Point(x=0.15, y=0.3)]
        return PushToGoal.Goal(kind=PushToGoal.Goal.KIND_EDGE, object_id=OBJECT, edge=ends, overhang=0.03, held=0.01)

    def _request(self, goal: PushToGoal.Goal) -> Any:
        request = self.bench.kind_of("push_ident_msgs/action/PushToGoal_SendGoal").Request(goal=goal)
        request.goal_id.uuid = list(np.random.default_rng().integers(0, 256, 16).tolist())
        return request
