"""What stands around each node while it is fuzzed: its parameters, valid traffic, and work that shows that it still does its job.

A node without a scene of its own is fuzzed all the same, with messages made from the types of its topics.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMsg
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from push_ident.bags.records import write_records
from push_ident.identification.predicting.prediction import predict
from push_ident.identification.predicting.scoring import PushScore, ScoreSummary
from push_ident.identification.results.posterior import prior_posterior
from push_ident.nodes.convert.goal_markers import GoalDrawing, goal_markers_to_msg
from push_ident.nodes.convert.messages import position_to_msg, stamp_to_msg, transform_to_msg
from push_ident.nodes.convert.model import map_to_msg, path_to_msg, prediction_to_msg, score_to_msg
from push_ident.physics.scenario import PushScenario
from push_ident.pushing.corridor import Corridor
from push_ident.types import PoseTrack, PusherPath, PushRecord
from push_ident_msgs.msg import GapReport, HandCommand, HandStatus
from push_ident_msgs.srv import LoadModel, PredictPush
from push_ident_sim.cell.robot import HOME, JOINT_NAMES, robot_description
from push_ident_sim.cell.sensors import PLAIN, suitable_pose
from push_ident_sim.fuzz.bench import Bench, NodeFailure, granted
from push_ident_sim.fuzz.traffic import (
    KINDS,
    OBJECT,
    RADIUS,
    depth_messages,
    diagnosis_text,
    length_of,
    push_messages,
    shape_messages,
    table_messages,
)
from push_ident_sim.objects import make_object
from push_ident_sim.recordings.truth import true_model

__all__ = ["SCENES", "Scene"]

_PATIENCE: Final = 15.0
"""For a node to do its work [s], as granted."""
_RECENT: Final = 4
"""Latest valid messages of each topic that mutations start from."""
_DIAGNOSIS: Final = "diagnosis.json"
_LATCHED_TOPICS: Final = frozenset({"/pusher/shape", f"/objects/{OBJECT}/cells", f"/objects/{OBJECT}/outline"})


class Scene:
    """Surroundings of any node: nothing but what every node answers."""

    own_parameters: ClassVar[dict[str, object]] = {}
    transitions: ClassVar[tuple[int, ...]] = (1, 2, 3, 4)
    """Of its lifecycle, as a mutated request may ask for: configure, clean up, activate, deactivate."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.recent: dict[str, deque[Any]] = {}
        """Latest valid messages by topic."""
        self.kept: list[tuple[str, Any]] = []
        """Latched messages, as their publishers would have them."""

    @classmethod
    def parameters(cls, folder: Path) -> dict[str, object]:
        """Parameters of the node; `folder` is its own."""
        return dict(cls.own_parameters)

    def prepare(self) -> None:
        """Make publishers before the node looks for them."""

    def step(self) -> None:
        """Publish a little valid traffic."""

    def settle(self) -> None:
        """Publish all latched messages again, as a restarted driver does."""
        for topic, msg in self.kept:
            self.send(topic, msg)
        self.bench.probe()

    def work(self) -> None:
        """Let the node do its work once. Raises NodeFailure `no work` when it does not."""
        self.bench.probe()

    def requests(self, service: str) -> list[Any]:
        """Valid requests to mutate."""
        return []

    def check(self) -> None:
        """Raise NodeFailure for what the node has published."""

    def send(self, topic: str, msg: Any) -> None:
        """Publish a valid message."""
        self.recent.setdefault(topic, deque(maxlen=_RECENT)).append(msg)
        self.bench.publish(topic, type(msg), msg, valid=True)

    def keep(self, topic: str, msg: Any) -> None:
        """Offer a latched message."""
        self.bench.offer(topic, type(msg), latched=True)
        self.kept.append((topic, msg))
        self.send(topic, msg)

    def require(self, condition: bool, what: str) -> None:
        """Raise NodeFailure unless the node did its work."""
        if not condition:
            self.bench.check()
            raise NodeFailure("no work", f"{what}; its diagnostics: {str(self.bench.diagnostics)[:800]}")


class Pushes(Scene):
    """Pushes of a hammer, as a cell publishes them."""

    counter = "pushes"
    """Key in diagnostics that rises with each push that was taken in."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        self._seeds = itertools.count(1)
        self._start = 10.0
        self._waiting: Iterator[tuple[str, Any]] = iter(())

    def prepare(self) -> None:
        """Shapes; poses and pusher."""
        for topic, msg in shape_messages():
            self.keep(topic, msg)
        for topic, kind in KINDS.items():
            if topic not in _LATCHED_TOPICS:
                self.bench.offer(topic, kind)

    def next_push(self) -> list[tuple[str, Any]]:
        """Messages of another push, later than the one before."""
        messages = push_messages(next(self._seeds), self._start)
        self._start += length_of(messages)
        return messages

    def step(self) -> None:
        """A few messages of the push under way."""
        taken = list(itertools.islice(self._waiting, 6))
        if not taken:
            self._waiting = iter(self.next_push())
        for topic, msg in taken:
            self.send(topic, msg)

    def work(self) -> None:
        """A whole push is taken in."""
        self._waiting = iter(())
        self.require(self.bench.await_report(lambda values: True), "no diagnostics within 5 s")
        before = int(self.bench.diagnostics.get(self.counter, "0"))
        self.whole_push()
        taken = self.bench.await_report(lambda values: int(values.get(self.counter, "0")) > before, _PATIENCE)
        self.require(taken, f"a valid push was not taken in ({self.counter} stays {before})")

    def whole_push(self) -> None:
        """Publish one push from start to end."""
        self._start += 20.0
        for i, (topic, msg) in enumerate(self.next_push()):
            self.send(topic, msg)
            if i % 8 == 0:
                self.bench.probe()

    def path(self) -> PathMsg:
        """A path of the pusher towards the object."""
        return path_to_msg(PusherPath(np.array([0.0, 1.0]), np.array([[-0.25, 0.0], [-0.05, 0.0]]), RADIUS))


class Identification(Pushes):
    """The push is learned, and the prediction asked for is finite."""

    own_parameters: ClassVar[dict[str, object]] = {"suggest_candidates": 4, "max_solve_time": 2.0}

    def prepare(self) -> None:
        """Also the table, and a diagnosis: as a report, and as a file."""
        super().prepare()
        for topic, msg in table_messages():
            self.keep(topic, msg)
        report = GapReport(object_id=OBJECT, json=diagnosis_text())
        report.header.stamp = stamp_to_msg(1.0)
        self.keep("/gap_report", report)
        (self.bench.folder / _DIAGNOSIS).write_text(diagnosis_text(), encoding="utf-8")

    def work(self) -> None:
        """Also predict."""
        super().work()
        answer = self.bench.call("/predict_push", PredictPush, PredictPush.Request(object_id=OBJECT, pusher_path=self.path()))
        self.require(bool(answer.success), f"predict_push: {answer.message}")
        poses = [(p.pose.position.x, p.pose.position.y, *p.covariance) for p in answer.prediction.poses]
        self.require(bool(len(poses)) and bool(np.isfinite(poses).all()), "the prediction is not finite")

    def requests(self, service: str) -> list[Any]:
        """A prediction; files in the node's own folder."""
        if service == "/predict_push":
            pose = position_to_msg(stamp_to_msg(1.0), [0.0, 0.0, 0.0])
            return [PredictPush.Request(object_id=OBJECT, pusher_path=self.path(), object_pose=pose)]
        if service == "/load_diagnosis":
            return [LoadModel.Request(object_id=OBJECT, path=path) for path in (_DIAGNOSIS, "")]
        if service in ("/save_model", "/load_model"):
            kind = self.bench.kind_of(f"push_ident_msgs/srv/{'Save' if 'save' in service else 'Load'}Model")
            return [kind.Request(object_id=OBJECT, path="model.json")]
        return []


class Diagnosis(Pushes):
    """A push more to diagnose."""

    own_parameters: ClassVar[dict[str, object]] = {"outline_from_camera": False}

    def prepare(self) -> None:
        """Also the table."""
        super().prepare()
        for topic, msg in table_messages():
            self.keep(topic, msg)


class Recorder(Pushes):
    """What is published is written. Cleaning up ends the bag, which is not overwritten afterwards: this is not asked for."""

    transitions: ClassVar[tuple[int, ...]] = (1, 3, 4)
    counter = "/pusher/pose"

    @classmethod
    def parameters(cls, folder: Path) -> dict[str, object]:
        """A bag in the node's own folder."""
        n = next(i for i in itertools.count() if not (folder / f"bag{i}").exists())
        return {"bag": str(folder / f"bag{n}"), "min_free_mib": 10}

    def prepare(self) -> None:
        """Small depth images besides."""
        super().prepare()
        self._depth = depth_messages(shrink=16)
        for topic, kind in (("/depth/image_rect", Image), ("/depth/camera_info", CameraInfo)):
            self.bench.offer(topic, kind)

    def step(self) -> None:
        """An image now and then."""
        super().step()
        for topic, msg in zip(("/depth/image_rect", "/depth/camera_info"), next(self._depth), strict=True):
            self.send(topic, msg)


class Viewer(Recorder):
    """What is published is written to a recording."""

    transitions: ClassVar[tuple[int, ...]] = Scene.transitions
    own_parameters: ClassVar[dict[str, object]] = {"output": "file", "pose_rate": 15.0}

    @classmethod
    def parameters(cls, folder: Path) -> dict[str, object]:
        """A recording in the node's own folder."""
        return cls.own_parameters | {"file": str(folder / "scene.rrd")}

    def prepare(self) -> None:
        """What identification and goal pushing publish besides."""
        super().prepare()
        shape = true_model(make_object("hammer", 0)).shape
        posterior, stamp = prior_posterior(shape), stamp_to_msg(1.0)
        path = PusherPath(np.array([0.0, 1.0]), np.array([[-0.25, 0.0], [-0.05, 0.0]]), RADIUS)
        moved = prediction_to_msg(predict(posterior, PushScenario(path, np.zeros(3), np.linspace(0, 1, 5))), OBJECT, (1, "fine"))
        score = PushScore(1, "push 1", 1.0, 0.002, 0.003, 2.0, 0.009)
        prefix = f"/objects/{OBJECT}"
        line = np.array([[-0.05, 0.0], [0.0, 0.01], [0.05, 0.0]])
        corridor = Corridor(line, 0.03).outline()
        goal = GoalDrawing(OBJECT, shape.outline, "path", line, shape.outline, "push 1", line[:2], line, corridor)
        self.keep("/push_to_goal/markers", goal_markers_to_msg(goal, stamp))
        self.keep("/depth/camera_pose", transform_to_msg(stamp, suitable_pose(PLAIN)))
        self.keep(f"{prefix}/mass_friction_map", map_to_msg(posterior, OBJECT, stamp, None, 0))
        self.keep(f"{prefix}/prediction", moved)
        self.keep(f"{prefix}/next_push_prediction", moved)
        self.keep(f"{prefix}/next_push", path_to_msg(path))
        self.keep(f"{prefix}/push_score", score_to_msg(score, ScoreSummary(1, 0.002, 0.003, 0.009, 1.0), OBJECT, 1.0))

    def step(self) -> None:
        """Words of another node besides."""
        super().step()
        self.send("/diagnostics", DiagnosticArray(status=[DiagnosticStatus(name="/other_node", message="slow", level=b"\x01")]))

    def work(self) -> None:
        """The recording grows."""
        recording = self.bench.folder / "scene.rrd"
        before = recording.stat().st_size if recording.exists() else 0
        self.whole_push()
        grown = self.bench.wait(lambda: recording.exists() and recording.stat().st_size > before, _PATIENCE)
        self.require(grown, "the recording does not grow")


class Perceived(Scene):
    """Depth images of a hammer at rest, the tool and the arm beside it."""

    own_parameters: ClassVar[dict[str, object]] = {
        "camera_position": [0.55, 0.0, 0.85],
        "camera_quaternion": [0.67815377, 0.67815377, -0.20026847, -0.20026847],
        "use_sim_time": True,
    }

    def prepare(self) -> None:
        """Camera, tool, joints, description, clock."""
        self._stamp, self._steps = 100.0, 0
        self._depth = depth_messages()
        for topic, kind in (
            ("/depth/image_rect", Image),
            ("/depth/camera_info", CameraInfo),
            ("/tool/pose", PoseStamped),
            ("/joint_states", JointState),
            ("/clock", Clock),
        ):
            self.bench.offer(topic, kind)
        self.keep("/pusher/shape", shape_messages()[2][1])
        self.keep("/robot_description", String(data=robot_description()))

    def step(self) -> None:
        """A frame now and then: each costs the node some 50 ms."""
        self._steps += 1
        if self._steps % 4 == 0:
            self._frame()

    def _frame(self) -> None:
        self._stamp += 1 / 15
        stamp = stamp_to_msg(self._stamp)
        image, info = next(self._depth)
        image.header.stamp = stamp
        info.header = type(info.header)(stamp=stamp, frame_id=image.header.frame_id)
        joints = JointState(name=list(JOINT_NAMES), position=[1.4, *HOME[1:]])
        joints.header.stamp = stamp
        self.send("/clock", Clock(clock=stamp))
        self.send("/joint_states", joints)
        self.send("/tool/pose", position_to_msg(stamp, [-0.3, 0.3, 0.2]))
        self.send("/depth/camera_info", info)
        self.send("/depth/image_rect", image)

    def work(self) -> None:
        """Poses come out of valid frames."""
        self._stamp += 5.0
        self.require(self.bench.await_report(lambda values: True), "no diagnostics within 5 s")
        before, deadline = int(self.bench.diagnostics.get("poses", "0")), time.monotonic() + granted(_PATIENCE)
        while int(self.bench.diagnostics.get("poses", "0")) <= before:
            self.require(time.monotonic() < deadline, "valid frames give no pose")
            self._frame()
            self.bench.probe()


class Hand(Scene):
    """The hand does what is commanded."""

    def prepare(self) -> None:
        """Commands and states."""
        self._state = HandStatus()
        self.bench.offer("/Robotiq3FGripper/OutputRegisters", HandCommand)
        self.bench.node.create_subscription(HandStatus, "/Robotiq3FGripper/InputRegisters", self._on_state, 10)

    def _on_state(self, msg: HandStatus) -> None:
        self._state = msg

    def step(self) -> None:
        """A command."""
        self.send("/Robotiq3FGripper/OutputRegisters", HandCommand(r_act=1, r_gto=1, r_pra=255))

    def work(self) -> None:
        """It closes."""
        deadline = time.monotonic() + granted(_PATIENCE)
        while not (self._state.g_pra == 200 and self._state.g_imc == 3):
            self.require(time.monotonic() < deadline, "the hand does not close")
            self.send("/Robotiq3FGripper/OutputRegisters", HandCommand(r_act=1, r_gto=1, r_pra=200, r_spa=255))
            self.bench.spin(0.2)


class Cell(Scene):
    """The simulated arm goes where it is sent."""

    own_parameters: ClassVar[dict[str, object]] = {"camera_rate": 0.0, "truth_as_perception": True, "real_time_factor": 1.0}

    def prepare(self) -> None:
        """Commands and states."""
        self._q = np.zeros(7)
        self._goals = itertools.cycle((0.2, 0.3))
        self.bench.offer("/joint_trajectory", JointTrajectory)
        self.bench.node.create_subscription(JointState, "/joint_states", self._on_state, 10)

    def _on_state(self, msg: JointState) -> None:
        self._q = np.array(msg.position)
        if not np.isfinite(self._q).all() or np.abs(self._q).max() > 10.0:
            raise NodeFailure("motion", f"joint states {self._q}")

    def _command(self, first: float) -> JointTrajectory:
        point = JointTrajectoryPoint(positions=[first, *HOME[1:]], velocities=[0.0] * 7)
        point.time_from_start.nanosec = 500_000_000
        return JointTrajectory(joint_names=list(JOINT_NAMES), points=[point])

    def step(self) -> None:
        """A command."""
        self.send("/joint_trajectory", self._command(0.25))

    def work(self) -> None:
        """It arrives."""
        goal = next(self._goals)
        deadline = time.monotonic() + granted(_PATIENCE)
        while abs(self._q[0] - goal) > 0.02:
            self.require(time.monotonic() < deadline, f"joint 1 is at {self._q[0]:.3f}, sent to {goal}")
            self.send("/joint_trajectory", self._command(goal))
            self.bench.spin(1.0)


class Player(Scene):
    """A short bag, again and again."""

    @classmethod
    def parameters(cls, folder: Path) -> dict[str, object]:
        """A bag in the node's own folder."""
        bag = folder / "played"
        if not bag.exists():
            write_records(bag, [_example_record()])
        return {"bag": str(bag), "loop": True, "listeners": 0, "wait": 0.0}

    def prepare(self) -> None:
        """Listen."""
        self._poses = 0
        self.bench.node.create_subscription(PoseWithCovarianceStamped, f"/objects/{OBJECT}/pose", self._on_pose, 10)

    def _on_pose(self, msg: PoseWithCovarianceStamped) -> None:
        self._poses += 1

    def work(self) -> None:
        """Poses come."""
        before = self._poses
        self.require(self.bench.wait(lambda: self._poses > before, _PATIENCE), "the player plays no poses")


def _example_record() -> PushRecord:
    time_, shape = np.linspace(0.0, 1.0, 30), true_model(make_object("hammer", 0)).shape
    poses = PoseTrack(time_, np.zeros((30, 3)), np.broadcast_to(1e-6 * np.eye(3), (30, 3, 3)))
    pusher = PusherPath(time_, np.column_stack([np.linspace(-0.3, -0.2, 30), np.zeros(30)]), RADIUS)
    return PushRecord(OBJECT, shape, poses, pusher)


SCENES: Final[dict[str, type[Scene]]] = {
    "perception_node": Perceived,
    "identification_node": Identification,
    "gap_diagnosis_node": Diagnosis,
    "bag_recorder_node": Recorder,
    "viewer_node": Viewer,
    "sim_hand_node": Hand,
    "sim_cell_node": Cell,
    "bag_player_node": Player,
}
"""By executable."""
