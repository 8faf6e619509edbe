"""A blocking client of a live cell, for commands and tests: push, predict, wait for maps."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any, Final, TypeVar

import numpy as np
import rclpy
from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import String
from unique_identifier_msgs.msg import UUID

from push_ident.errors import PushIdentError
from push_ident.geometry.se2 import wrap_angle
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.executors import make_executor
from push_ident.nodes.base.guard import Guard
from push_ident.nodes.base.keep_alive import KeepAlive, ServerWatch, cancellation
from push_ident.nodes.base.lifetime import stopping_in_order
from push_ident.nodes.client.listen import start_ros
from push_ident.nodes.convert.messages import planar_pose_from_msg, pusher_shape_from_msg
from push_ident.nodes.input.objects import ObjectTopics, ShapeInput
from push_ident.types import Float64Array, ObjectShape, PusherShape
from push_ident_msgs.action import DiagnoseGap, ExecutePush, PushToGoal
from push_ident_msgs.msg import MassFrictionMap, PushPrediction
from push_ident_msgs.srv import PredictPush, SaveModel

_ANY: Final = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_AVAILABLE)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ClientTimes:
    """How long a client waits for what, wall time."""

    poll: float = 0.02
    """Between two looks of the thread of the caller [s]."""
    spin: float = 0.05
    """Between two looks whether the client is over, in the thread that spins [s]."""
    answer: float = 20.0
    """For a server to be there, to discover this node, and to accept a goal [s]."""
    cancel: float = 1.0
    """For the answer to a cancellation [s]; the arm holds within 50 ms."""
    service: float = 90.0
    """For an answer of identification [s]: the first solve of an installation compiles its kernels, some 50 s of one core."""


CLIENT: Final = ClientTimes()


class CellTimeout(PushIdentError):
    """A node did not answer in time; the text names the node and a remedy."""


class _OneLine:
    """Logger of a guard on the command line: the first refusal is shown, the others are counted."""

    def __init__(self, node: Node) -> None:
        self._node, self._has_spoken = node, False

    def warning(self, text: str) -> None:
        if not self._has_spoken:
            self._has_spoken = True
            self._node.get_logger().warning(text)

    def debug(self, text: str) -> None:
        self._node.get_logger().debug(text)


class _ClientNode(Node):  # type: ignore[misc]
    """A node whose callbacks all go through `guard`, as those of a `CellNode`."""

    def __init__(self, name: str, is_alive: Callable[[], bool]) -> None:
        logger = _OneLine(self)
        self.guard = Guard(lambda: logger, is_alive)
        super().__init__(name)

    def create_subscription(self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **kwargs: Any) -> Any:
        """As of rclpy, guarded."""
        return super().create_subscription(msg_type, topic, self.guard.callback(topic, callback), qos_profile, **kwargs)

    def create_timer(self, timer_period_sec: float, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """As of rclpy, guarded."""
        return super().create_timer(timer_period_sec, self.guard.callback("timer", callback), *args, **kwargs)


class CellClient:
    """A client of the nodes of one cell. Use it as a context manager; its callbacks run in a separate thread, which no message ends.

    In the main thread, SIGTERM and SIGHUP end the context as Ctrl-C does, by `SystemExit`: what is under way is cancelled.

    Args:
        check: called while waiting; may raise to end the wait (such as the check of a supervisor for dead nodes).
    """

    def __init__(self, *, check: Callable[[], None] = lambda: None) -> None:
        self._check = check
        start_ros(signal_handler_options=SignalHandlerOptions.NO)
        self._is_over = threading.Event()
        self.node = _ClientNode("push_ident_client", lambda: not self._is_over.is_set())
        self._poses: dict[str, deque[tuple[float, Float64Array]]] = {}
        self._maps: dict[str, MassFrictionMap] = {}
        self._map_received = time.monotonic()
        self._shape_input, self._outlined = ShapeInput(), set[str]()
        self._shapes: dict[str, ObjectShape] = {}
        self.tool: PusherShape | None = None
        self.diagnostics: dict[str, DiagnosticStatus] = {}
        self._diagnosed = -np.inf
        """When identification's diagnostics came [s], `time.monotonic`."""
        self._topics = ObjectTopics(self.node, self._on_new_object)
        self._push = ActionClient(self.node, ExecutePush, "execute_push")
        self._diagnose = ActionClient(self.node, DiagnoseGap, "diagnose_gap")
        self._push_to = ActionClient(self.node, PushToGoal, "push_to_goal")
        self._keep_alive = {name: KeepAlive(self.node, name) for name in ("execute_push", "push_to_goal")}
        # Last: a server that answers these has discovered the ends of the actions as well.
        self._probes = {
            name: self.node.create_client(CancelGoal, f"{name}/_action/cancel_goal")
            for name in ("execute_push", "diagnose_gap", "push_to_goal")
        }
        self._predict = self.node.create_client(PredictPush, "predict_push")
        self._save = self.node.create_client(SaveModel, "save_model")
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self.node.create_subscription(SolidPrimitive, "pusher/shape", self._on_pusher_shape, LATCHED)
        self._stopping = ExitStack()
        self._executor = make_executor(1)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name="client", daemon=True)
        self._thread.start()

    def __enter__(self) -> CellClient:
        self._stopping.enter_context(stopping_in_order())
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._is_over.set()
        self._executor.shutdown(timeout_sec=0.5)
        self._thread.join(timeout=1.0)
        self.node.destroy_node()
        rclpy.try_shutdown()
        self._stopping.close()

    def _spin(self) -> None:
        while not self._is_over.is_set() and self.node.context.ok():
            with self.node.guard.watch("client"):
                self._executor.spin_once(timeout_sec=CLIENT.spin)

    def wait(self, what: Callable[[], T | None], timeout: float, missing: str, last_heard: Callable[[], float] | None = None) -> T:
        """Wait until `what` returns something else than None or False.

        Args:
            last_heard: Time of the last sign of life [s], of `time.monotonic`; the timeout counts from it instead of from now.

        Raises CellTimeout: `timeout` [s] of wall time has passed; the text is `missing`.
        """
        started = time.monotonic()
        while (value := what()) is None or value is False:
            self._check()
            if time.monotonic() > timeout + (started if last_heard is None else last_heard()):
                raise CellTimeout(missing)
            time.sleep(CLIENT.poll)
        return value

    # ---- observations

    def wait_for_object(self, timeout: float = 60.0) -> str:
        """Id of the first object with poses and cells."""

        def complete() -> str | None:
            return next((i for i in sorted(self._poses) if self._poses[i] and self.is_known(i)), None)

        try:
            return self.wait(complete, timeout, "")
        except CellTimeout:
            why = self.reasons() or "no diagnostics; is perception running?"
            raise CellTimeout(f"no object after {timeout:.0f} s ({why})") from None

    def object_ids(self) -> tuple[str, ...]:
        """Every object whose poses are or were published, sorted."""
        return self._topics.ids

    def poses(self, object_id: str) -> list[tuple[float, Float64Array]]:
        """The latest poses of an object with their stamps, oldest first."""
        return list(self._poses.get(object_id, ()))

    def pose_at_rest(self, object_id: str, after: float, n: int = 5, timeout: float = 20.0) -> Float64Array:
        """Mean of `n` poses stamped later than `after` [s]; the object should be at rest."""

        def later() -> list[Float64Array] | None:
            poses = [pose for stamp, pose in self.poses(object_id) if stamp > after]
            return poses if len(poses) >= n else None

        poses = self.wait(later, timeout, f"object {object_id} has fewer than {n} new poses within {timeout:.0f} s; is it hidden?")[-n:]
        mean: Float64Array = np.mean(poses, axis=0)
        # Yaw may wrap between frames.
        turn = wrap_angle(np.array([pose[2] for pose in poses]) - poses[0][2])
        mean[2] = poses[0][2] + float(np.mean(turn))
        return mean

    def is_known(self, object_id: str) -> bool:
        """Whether cells and outline of an object were received."""
        return object_id in self._shapes

    def shape(self, object_id: str) -> ObjectShape:
        """Cells and outline of an object that `wait_for_object` returned, or that `is_known`."""
        return self._shapes[object_id]

    def latched_text(self, topic: str, timeout: float = 10.0) -> str:
        """The last text published on a latched topic."""
        texts: list[str] = []
        subscription = self.node.create_subscription(String, topic, lambda msg: texts.append(msg.data), LATCHED)
        try:
            return self.wait(lambda: texts[-1] if texts else None, timeout, f"nothing on {topic} within {timeout:.0f} s")
        finally:
            self.node.destroy_subscription(subscription)

    def latest_map(self, object_id: str) -> MassFrictionMap | None:
        """Latest map of an object."""
        return self._maps.get(object_id)

    def wait_for_map(self, object_id: str, n_pushes: int, timeout: float = 120.0) -> MassFrictionMap:
        """The first map from at least so many finished pushes."""

        def enough() -> MassFrictionMap | None:
            latest = self._maps.get(object_id)
            return latest if latest is not None and latest.n_pushes >= n_pushes else None

        return self.wait(
            enough, timeout, f"no map of object {object_id} from {n_pushes} pushes within {timeout:.0f} s; see identification's log"
        )

    def wait_until_settled(self, quiet: float, patience: float) -> None:
        """Wait until all that was sent has been learned or refused, and no map has come for `quiet` [s] of wall time.

        Identification reports it in its diagnostics: its streams are at rest, and neither a push nor a better outline is waiting.

        Raises CellTimeout: identification reported nothing new for `patience` [s] of wall time.
        """
        started = time.monotonic()

        def settled() -> bool:
            since = max(self._map_received, started) + quiet
            values = self.values_of("identification")
            waiting = {values.get(what) for what in ("pushes waiting", "outlines waiting")}
            return values.get("streams") == "at rest" and waiting == {"0"} and self._diagnosed > since

        missing = f"identification reported nothing new for {patience:.0f} s and is not done; see its log"
        self.wait(settled, patience, missing, self.heard_from("identification"))

    def values_of(self, node: str) -> dict[str, str]:
        """Values in the latest diagnostics of a node whose name contains `node`; empty before the first."""
        values: Sequence[Any] = next((status.values for name, status in self.diagnostics.items() if node in name), [])
        return {value.key: value.value for value in values}

    def heard_from(self, node: str) -> Callable[[], float]:
        """When the values in the diagnostics of a node last changed [s], `time.monotonic`; for `wait`."""
        changed, last = time.monotonic(), self.values_of(node)

        def latest() -> float:
            nonlocal changed, last
            values = self.values_of(node)
            if values != last:
                changed, last = time.monotonic(), values
            return changed

        return latest

    def reasons(self) -> str:
        """What the nodes report of themselves."""
        return "; ".join(f"{name}: {status.message}" for name, status in sorted(self.diagnostics.items()))

    # ---- requests

    def execute_push(
        self, goal: ExecutePush.Goal, *, silence: float = 60.0, on_feedback: Callable[[Any], None] | None = None
    ) -> ExecutePush.Result:
        """Push (or plan only); returns the result whatever its error code.

        A push may take minutes, since another one may bring the object back to the middle first. The wait goes on while the executor
        sends feedback.

        Args:
            silence: longest time without feedback [s], wall time; planning sends none and a simulated cell may be slow.

        Raises CellTimeout: The action is not served, the goal was refused, or the executor is gone or sent no more feedback.
        """
        return self._carry_out(self._push, goal, "execute_push", "push_executor_node", silence, on_feedback)

    def push_to_goal(
        self, goal: PushToGoal.Goal, *, silence: float = 60.0, on_feedback: Callable[[Any], None] | None = None
    ) -> PushToGoal.Result:
        """Push an object to a goal; returns the result whatever its error code. An exception meanwhile, such as Ctrl-C, cancels the goal.

        Args:
            silence: longest time without feedback [s], wall time; the node sends some ten times a second.
            on_feedback: called with each feedback, in the thread of the caller.

        Raises CellTimeout: The action is not served, the goal was refused, or its node is gone or sent no more feedback.
        """
        return self._carry_out(self._push_to, goal, "push_to_goal", "goal_pushing_node", silence, on_feedback)

    def _carry_out(
        self, action: ActionClient, goal: Any, name: str, server: str, silence: float, on_feedback: Callable[[Any], None] | None
    ) -> Any:
        watch, number = self._find(action, name, server), self._keep_alive[name].begin()
        heard, news, results = time.monotonic(), deque[Any](), list[Future]()

        def take(msg: Any) -> None:
            nonlocal heard
            heard = time.monotonic()
            watch.heard()
            news.append(msg.feedback)

        def look() -> None:
            while news:
                feedback = news.popleft()
                if on_feedback is not None:
                    on_feedback(feedback)
            _check_there(watch, name, server)

        def ask_result() -> None:
            results.append(handle.get_result_async())

        def first_result() -> Any:
            look()
            return next((asked.result() for asked in results if asked.done()), None)

        try:
            handle = self._answer(
                lambda: action.send_goal_async(goal, feedback_callback=take, goal_uuid=number),
                CLIENT.answer,
                f"{name} did not answer within {CLIENT.answer:.0f} s",
                look,
            )
            if not handle.accepted:
                raise CellTimeout(f"{name} refused the goal")
            heard, watch.after_silence = time.monotonic(), ask_result
            self._executor.create_task(ask_result)
            missing = f"{name} sent no feedback for {silence:.0f} s and no result; see the log of {server}"
            response = self.wait(first_result, silence, missing, lambda: heard)
            if response.status == GoalStatus.STATUS_UNKNOWN:
                raise CellTimeout(f"{server} was started again meanwhile, so {name} gives no result; see its log, and ask anew")
            return response.result
        except BaseException:
            # Nobody waits for it any more: the arm holds.
            self._cancel(name, number, watch)
            raise
        finally:
            self._keep_alive[name].end(number)

    def _cancel(self, name: str, goal: UUID, server: ServerWatch) -> None:
        """Sent from this thread: the one that spins may be stuck. A server that is gone gives no answer."""
        answer = self._probes[name].call_async(cancellation(goal))
        with suppress(PushIdentError):
            self.wait(lambda: answer.done() or bool(server.why_gone()), CLIENT.cancel, f"{name} did not answer the cancellation")

    def diagnose_gap(self, goal: DiagnoseGap.Goal, *, timeout: float = 600.0) -> DiagnoseGap.Result:
        """Diagnose the pushes so far.

        Raises CellTimeout: the action is not served, refused the goal, took longer than `timeout` [s], or its node is gone.
        """
        name, server = "diagnose_gap", "gap_diagnosis_node"
        watch = self._find(self._diagnose, name, server)
        handle = self._answer(
            lambda: self._diagnose.send_goal_async(goal), CLIENT.answer, f"{name} did not answer within {CLIENT.answer:.0f} s"
        )
        if not handle.accepted:
            raise CellTimeout(f"{name} refused the goal; is a diagnosis under way?")
        missing = f"{name} gave no result within {timeout:.0f} s"
        return self._answer(handle.get_result_async, timeout, missing, lambda: _check_there(watch, name, server)).result

    def predict(self, object_id: str, path: Path) -> PushPrediction:
        """Prediction of the identified model for a push along `path`, from the object's latest pose."""
        request = PredictPush.Request(object_id=object_id, pusher_path=path)
        answer = self._call(self._predict, request, "predict_push")
        return answer.prediction

    def save_model(self, object_id: str, path: str) -> None:
        """Let the identification node write its model to a file."""
        self._call(self._save, SaveModel.Request(object_id=object_id, path=path), "save_model")

    def _call(self, client: Any, request: Any, name: str) -> Any:
        self.wait(client.service_is_ready, CLIENT.answer, f"the service {name} is not served; is identification_node running?")
        missing = f"{name} did not answer within {CLIENT.service:.0f} s; see the log of identification_node"
        answer = self._answer(lambda: client.call_async(request), CLIENT.service, missing)
        if not answer.success:
            raise PushIdentError(f"{name}: {answer.message}")
        return answer

    def _find(self, action: ActionClient, name: str, server: str) -> ServerWatch:
        """Wait until the server of an action can answer this node: a goal must not be sent twice."""
        self.wait(action.server_is_ready, CLIENT.answer, f"the action {name} is not served; is {server} running?")
        watch = ServerWatch(action, self._probes[name])

        def answers() -> bool:
            watch.why_gone()
            return watch.has_answered

        self.wait(answers, CLIENT.answer, f"the server of {name} did not answer within {CLIENT.answer:.0f} s; see the log of {server}")
        return watch

    def _answer(self, ask: Callable[[], Future], timeout: float, missing: str, look: Callable[[], None] = lambda: None) -> Any:
        """The answer to a request; `look` is called while it is awaited."""
        # The request is made in the thread that spins: otherwise the answer may arrive before the request is registered, and is dropped.
        asked: Future = self._executor.create_task(ask)

        def answered() -> bool:
            look()
            return bool(asked.done() and asked.result().done())

        self.wait(answered, timeout, missing)
        return asked.result().result()

    # ---- messages

    def _on_new_object(self, object_id: str) -> None:
        prefix = f"objects/{object_id}"
        poses: deque[tuple[float, Float64Array]] = deque(maxlen=3000)
        self._poses[object_id] = poses
        self.node.create_subscription(
            PoseWithCovarianceStamped, f"{prefix}/pose", lambda msg: poses.append(planar_pose_from_msg(msg)[:2]), _ANY
        )
        for kind, part in ((OccupancyGrid, "cells"), (PolygonStamped, "outline")):
            self.node.create_subscription(kind, f"{prefix}/{part}", partial(self._on_shape, object_id, part), LATCHED)
        self.node.create_subscription(MassFrictionMap, f"{prefix}/mass_friction_map", lambda msg: self._on_map(object_id, msg), LATCHED)

    def _on_shape(self, object_id: str, part: str, msg: Any) -> None:
        shape = self._shape_input.add(object_id, **{part: msg})
        if part == "outline":
            self._outlined.add(object_id)
        if shape is not None and object_id in self._outlined:
            self._shapes[object_id] = shape

    def _on_map(self, object_id: str, msg: MassFrictionMap) -> None:
        self._maps[object_id] = msg
        self._map_received = time.monotonic()

    def _on_pusher_shape(self, msg: SolidPrimitive) -> None:
        self.tool = pusher_shape_from_msg(msg)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        self.diagnostics.update({status.name: status for status in msg.status})
        if any("identification" in status.name for status in msg.status):
            self._diagnosed = time.monotonic()


def _check_there(watch: ServerWatch, name: str, server: str) -> None:
    if why := watch.why_gone():
        raise CellTimeout(f"{server} {why}, so {name} gives no result; see its log, and start it again")
