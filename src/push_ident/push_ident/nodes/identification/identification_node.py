"""Node `identification`: identifies the maps of every object while it is pushed, publishes them, and predicts pushes."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from push_ident.diagnosis.usable_effects import UsableEffects, usable_effects_of_file, usable_effects_of_text
from push_ident.errors import InputError, PushIdentError
from push_ident.identification.online.session import ObjectSession, SessionOptions
from push_ident.identification.predicting.possible_poses import ImpossiblePosesError, check_poses
from push_ident.identification.predicting.prediction import predict
from push_ident.identification.predicting.scoring import PushScore
from push_ident.identification.results.known_effects import effects_text
from push_ident.identification.results.model_file import load_model, save_model
from push_ident.identification.solvers import DEFAULT_SOLVER, SOLVERS
from push_ident.identification.unknowns.prior import Prior
from push_ident.limits import plain_text
from push_ident.nodes.base.cell_node import LATCHED, CellNode, Component, Health
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.base.paths import file_to_read, file_to_write
from push_ident.nodes.base.run import settle_memory
from push_ident.nodes.convert.messages import planar_pose_of, position_from_msg, stamp_from_msg
from push_ident.nodes.convert.model import pusher_path_from_msg
from push_ident.nodes.identification.output import ObjectOutput
from push_ident.nodes.identification.work import Kind, LatestJobs, WorkQueue
from push_ident.nodes.input.push_collector import PushCollector
from push_ident.nodes.input.table import CORNERS, TableInput, table_of_corners
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import compile_kernels
from push_ident.pushing.push import PushSettings
from push_ident.types import ObjectShape, PushRecord
from push_ident_msgs.msg import GapReport
from push_ident_msgs.srv import LoadModel, PredictPush, SaveModel

_IMPOSSIBLE: Final = "pushes with impossible poses, left out"
_EXCURSIONS: Final = "impossible poses, left out"

PARAMETERS: Final = (
    Parameter("total_mass", 0.5, "Nominal total mass of an object [kg]", 0.001, 1000.0, read_only=True),
    Parameter("total_mass_known", False, "Whether total_mass was weighed, for every object", read_only=True),
    Parameter("friction", 0.3, "Nominal support friction coefficient [-]", 0.001, 10.0, read_only=True),
    Parameter("pusher_friction", 0.3, "Nominal friction coefficient of the pusher [-]", 0.001, 10.0, read_only=True),
    Parameter("push_gap", 0.5, "Pause of the pusher that ends a push [s]", 0.05, 10.0, read_only=True),
    Parameter(
        "source",
        "",
        "Node that plays messages and publishes `done` at their end, as bag_player_node: until then silence ends no push; empty: a cell",
        read_only=True,
    ),
    Parameter("method", DEFAULT_SOLVER, "Solver of the maps", read_only=True, choices=tuple(SOLVERS)),
    Parameter("window", 8, "Latest pushes that are simulated again at every solve; older ones are summed up", 1, 100, read_only=True),
    Parameter("max_solve_time", 10.0, "Of the solve after a push [s]", 0.05, 600.0, read_only=True),
    Parameter("max_frame_time", 0.02, "Longest update at a frame, for methods without a bound [s]", 0.001, 1.0, read_only=True),
    Parameter("update_period", 0.0, "Shortest time between two updates during a push [s]; 0: at every frame", 0.0, 10.0),
    Parameter("prediction_period", 0.2, "Time between two predictions of the push under way [s]; 0: none", 0.0, 10.0),
    Parameter("prediction_horizon", 0.5, "How far ahead the push under way is predicted [s]", 0.05, 10.0),
    CORNERS,
    Parameter(
        "use_diagnosis",
        True,
        "Whether effects that gap_diagnosis_node names with enough probability join the model of the object, with their values",
    ),
    Parameter("suggest_candidates", 24, "Pushes to choose the next one from; 0: suggest none", 0, 500),
    Parameter("state_directory", "", "Where the state of each object is kept through restarts; empty: nowhere", read_only=True),
)


class IdentificationNode(CellNode):
    """Collects, hands pushes to a worker thread that solves, and publishes what it finds.

    A deactivated node keeps its models; a cleaned-up node keeps only what is in `state_directory`.
    """

    # The update at a frame must not wait for results that are only displayed.
    switch_interval = 2.5e-4
    # An outline must not wait behind the poses and forces of a whole push.
    in_turn = True

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("identification_node", PARAMETERS, check=lambda values: table_of_corners(values[CORNERS.name]), **kwargs)

    def make_component(self) -> Component:
        """Topics, services and the worker."""
        return _Identification(self)


class _Identification(Component):
    def __init__(self, node: CellNode) -> None:
        self._node = node
        self._settings = settings = node.settings
        folder = Path(settings["state_directory"]).expanduser() if settings["state_directory"] else None
        self._options = SessionOptions(
            prior=Prior(
                total_mass=settings["total_mass"],
                total_mass_std=0.0 if settings["total_mass_known"] else Prior().total_mass_std,
                friction=settings["friction"],
                pusher_friction=settings["pusher_friction"],
            ),
            method=settings["method"],
            window=settings["window"],
            max_seconds=settings["max_solve_time"],
            frame_seconds=settings["max_frame_time"],
            folder=folder,
        )
        self._solving = threading.Lock()  # of changes of a session; reading its posterior needs none
        self._sessions: dict[str, ObjectSession] = {}
        self._outputs: dict[str, ObjectOutput] = {}
        self._table = TableInput(node)
        self._solve_time = 0.0
        self._latencies: deque[float] = deque(maxlen=2000)
        self._updated: dict[str, float] = {}
        self._predicted: dict[str, float] = {}
        self._answered: dict[str, float] = {}
        """Stamp of the latest push of each object that was learned or refused [s]."""

        self._wake = threading.Condition()
        # During a push updates need the processor, and a suggestion of the next one would be for poses that change.
        self._is_pushing = False
        self._queue = WorkQueue()
        self._frames: dict[str, float] = {}  # objects with a new pose during a push, and when the pose came
        self._closing = False
        self._is_loaded = threading.Event()
        """Set when the worker has its kernels."""
        self._worker = threading.Thread(target=self._work, name="identify", daemon=True)
        # The update at a frame must not wait for results that are only displayed.
        self._advice = LatestJobs("advise", node.guard)
        self._collector = PushCollector(
            node,
            settings["push_gap"],
            on_object=self._on_object,
            on_shape=self._on_shape,
            on_pushes=self._on_pushes,
            on_left_out=self._on_left_out,
            on_frame=self._on_frame,
            source=settings["source"],
        )
        self._counts = self._collector.counts
        self._counts.update({_IMPOSSIBLE: 0, _EXCURSIONS: 0})
        node.create_service(PredictPush, "predict_push", self._predict_push)
        node.create_service(SaveModel, "save_model", self._save_model)
        node.create_service(LoadModel, "load_model", self._load_model)
        node.create_subscription(GapReport, "gap_report", self._on_report, LATCHED)
        node.create_service(LoadModel, "load_diagnosis", self._load_diagnosis)
        self._worker.start()

    def pause(self) -> None:
        self._collector.pause()

    def close(self) -> None:
        with self._wake:
            self._closing = True
            self._wake.notify()
        if self._is_loaded.is_set():
            self._worker.join(timeout=1.0)  # while it loads kernels it cannot stop, and has nothing to finish
        self._advice.close(timeout=0.2)

    # ---- input

    def _on_object(self, object_id: str) -> None:
        self._outputs[object_id] = ObjectOutput(self._node, object_id)

    def _on_shape(self, object_id: str, shape: ObjectShape) -> None:
        known = self._sessions.get(object_id)
        if known is None:
            self._sessions[object_id] = self._new_session(ObjectSession(object_id, shape, self._options))
        elif not known.shape.is_same_object(shape):
            self._node.get_logger().warning(
                f"object {object_id} has another shape now: it is a new object, and the model of the old one is put aside"
            )
            self._counts["objects replaced"] += 1
            self._sessions[object_id] = self._new_session(known.replaced_by(shape))
        elif known.is_new:
            with self._solving:
                known.refine_shape(shape)
            self._publish_model(known, 0.0)
        else:
            self._enqueue(Kind.OUTLINE, partial(self._refine, object_id, shape), instead_of=object_id)

    def _new_session(self, session: ObjectSession) -> ObjectSession:
        if session.restored:
            self._node.get_logger().info(f"object {session.object_id}: continues with {session.n_pushes} pushes from {session.file}")
            self._publish_map(session, 0.0, session.n_pushes)
        self._publish_model(session, 0.0)
        return session

    def _on_frame(self, object_id: str) -> None:
        with self._wake:
            # A frame that the worker had no time for is not lost: the next update includes it.
            self._counts["frames taken together"] += object_id in self._frames
            self._frames.setdefault(object_id, time.monotonic())
            self._wake.notify()

    def _on_report(self, msg: GapReport) -> None:
        """Use the effects of a diagnosis after the pushes that wait: it may be of them."""
        if not self._settings["use_diagnosis"]:
            return
        if not msg.object_id:
            raise InputError("The report names no object; its `object_id` is empty.")
        usable = usable_effects_of_text(msg.json, f"gap_report of `{plain_text(msg.object_id)}`")
        stamp = stamp_from_msg(msg.header.stamp)

        def use() -> None:
            try:
                self._use_effects(msg.object_id, usable, stamp)
            except PushIdentError as error:
                self._collector.refuse("diagnoses", "gap_report", str(error))

        self._enqueue(Kind.EFFECTS, use, instead_of=msg.object_id)

    def _on_pushes(self, pushes: list[list[PushRecord]]) -> None:
        with self._wake:
            for push in pushes:
                self._queue.put(Kind.PUSH, partial(self._finish, push))
            self._wake.notify()

    def _on_left_out(self) -> None:
        self._enqueue(Kind.PUSH, self._drop_updates)

    def _enqueue(self, kind: Kind, work: Callable[[], None], instead_of: str = "") -> None:
        with self._wake:
            self._queue.put(kind, work, instead_of=instead_of)
            self._wake.notify()

    # ---- the worker

    def _work(self) -> None:
        with self._node.guard.watch("identify"):
            compile_kernels(effects=True)
            settle_memory()
        self._is_loaded.set()
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closing or self._queue.first() or self._frames)
                if self._closing:
                    return
                ended = self._queue.first()
                frames: dict[str, float] = {}
                if ended is None:
                    frames, self._frames = self._frames, {}
            with self._node.guard.watch("identify"):
                if ended is not None:
                    ended()
                for object_id, received in frames.items():
                    self._update(object_id, received)
            if ended is not None:
                # Only now: a push that is being solved is waiting, too.
                with self._wake:
                    self._queue.first_is_done()

    def _drop_updates(self) -> None:
        """Go back to the finished pushes: the one under way is left out."""
        self._is_pushing = False
        for session in list(self._sessions.values()):
            with self._solving:
                had_any = session.drop_update()
            if had_any:
                self._publish_map(session, max(self._collector.now, 0.0), session.n_pushes)
            self._advise(session.object_id)

    def _refine(self, object_id: str, shape: ObjectShape) -> None:
        """Fit the pushes of an object again with an outline that perception knows better now."""
        session = self._sessions[object_id]
        with self._solving:
            is_fitted = session.shape.is_same_object(shape) and session.refine_shape(shape)
        if is_fitted:
            self._counts["outlines refined"] += 1
            self._publish_refitted(session)

    def _use_effects(self, object_id: str, usable: UsableEffects, stamp: float) -> str:
        """Fit the pushes of an object with the effects of a diagnosis whose newest push ended at `stamp` [s]; the id of the object."""
        session = self._chosen(object_id)
        if not session.n_pushes and np.isfinite(stamp):
            raise InputError(
                f"The diagnosis is of pushes of `{session.object_id}` that this node has not learned; write it to a file and load that "
                "(load_diagnosis) where it is the same object."
            )
        with self._solving:
            session.use_effects(usable.effects, n_pushes=usable.n_pushes, until=stamp, keep=usable.base)
        text = effects_text(session.posterior) or "none"
        self._node.get_logger().info(f"object {session.object_id}: effects of its diagnosis in the model: {text}")
        self._publish_refitted(session)
        return session.object_id

    def _publish_refitted(self, session: ObjectSession) -> None:
        self._publish_map(session, max(self._collector.now, 0.0), session.n_pushes)
        self._publish_model(session, self._answered.get(session.object_id, 0.0))
        self._advise(session.object_id)

    def _finish(self, push: list[PushRecord]) -> None:
        self._is_pushing = False
        if not push:
            why = self._collector.what_is_missing() or "no object has poses before and after it; is it hidden?"
            self._collector.refuse("pushes", "identify", f"a push is left out: {why}")
        for record in push:
            session = self._sessions[record.object_id]
            known_again = session.n_known_again
            started, stamp = time.perf_counter(), float(record.poses.time[-1])
            try:
                with self._solving:
                    self._check_on_table(session, record)
                    score = session.finish(record)
            except Exception as error:
                # The next object of this push, and the next push, may be fine.
                self._counts[_IMPOSSIBLE] += isinstance(error, ImpossiblePosesError)
                self._publish_map(session, stamp, session.n_pushes)
                self._collector.refuse("pushes", "identify", f"{record.object_id}, {record.source}: {self._node.guard.explain(error)}")
                continue
            finally:
                # Also where nothing was learned: the client that pushed waits for it.
                self._publish_model(session, stamp)
            self._solve_time = time.perf_counter() - started
            self._say_left_out(session, record)
            if score is None:
                self._counts["pushes known already" if session.n_known_again > known_again else "pushes without contact"] += 1
                self._advise(record.object_id)
                continue
            self._counts["pushes"] += 1
            self._publish_map(session, stamp, session.n_pushes)
            self._outputs[record.object_id].publish_score(score, session.record.summary, stamp)
            self._node.get_logger().info(
                f"object {record.object_id}: push {session.n_pushes}, {session.status.name.lower() if session.status else ''}, "
                f"{1e3 * self._solve_time:.0f} ms; "
                f"predicted to {1e3 * score.cell_error:.1f} mm, expected {1e3 * score.expected_cell_error:.1f} mm"
            )
            self._say_unexplained(session, score)
            self._say_wrong(session)
            self._advise(record.object_id)

    def _check_on_table(self, session: ObjectSession, record: PushRecord) -> None:
        """Raise InputError where the object overhung the table: its cells in the air bear no load, which the model does not know of."""
        checked = check_poses(record)
        if not checked.why and (over := self._table.beyond(checked.record)) > 0.0:
            session.drop_update()
            raise InputError(f"it overhung the edge of the table by {1e3 * over:.0f} mm; such a push is left out.")

    def _say_left_out(self, session: ObjectSession, record: PushRecord) -> None:
        """Count and log poses of a push that are not learned."""
        checked = session.checked
        if checked is not None and checked.n_left_out:
            self._counts[_EXCURSIONS] += checked.n_left_out
            self._collector.last_error = f"{record.object_id}, {record.source}: {checked.note}"
            self._node.get_logger().warning(f"object {self._collector.last_error}")

    def _say_unexplained(self, session: ObjectSession, score: PushScore) -> None:
        """Count and log a push that contradicts the model, or a model that contradicts its pushes."""
        if score.explained:
            return
        self._counts["pushes not explained"] += 1
        why = session.failure or "its poses contradict the model of the other pushes; look at its poses"
        self._node.get_logger().warning(f"object {session.object_id}: push {session.n_pushes} is not explained: {why}")

    def _say_wrong(self, session: ObjectSession) -> None:
        """Log what is wrong with the pushes of an object, and keep it as the latest error of the diagnostics."""
        for warning in session.warnings:
            self._collector.last_error = f"{session.object_id}: {warning}"
            self._node.get_logger().warning(f"object {self._collector.last_error}")

    def _update(self, object_id: str, received: float) -> None:
        now = time.monotonic()
        if now - self._updated.get(object_id, -np.inf) < self._settings["update_period"]:
            return
        record = self._collector.partial(object_id)
        session = self._sessions.get(object_id)
        if record is None or session is None or self._table.beyond(record) > 0.0:
            return
        self._updated[object_id] = now
        self._is_pushing = True
        with self._solving:
            update = session.update(record)
        if update is None:
            return
        self._publish_map(session, float(record.poses.time[-1]), session.n_pushes + 1)
        self._latencies.append(time.monotonic() - received)
        self._counts["updates during a push"] += 1
        period = self._settings["prediction_period"]
        if period and self._outputs[object_id].prediction_is_wanted and now - self._predicted.get(object_id, -np.inf) >= period:
            self._predicted[object_id] = now
            self._advice.put(f"motion of {object_id}", partial(self._predict_under_way, session, record))

    def _predict_under_way(self, session: ObjectSession, record: PushRecord) -> None:
        prediction = session.predict_under_way(record, self._settings["prediction_horizon"])
        self._outputs[session.object_id].publish_prediction(prediction, session.status, session.n_pushes + 1)

    def _advise(self, object_id: str) -> None:
        if self._settings["suggest_candidates"]:
            self._advice.put(f"next push of {object_id}", partial(self._suggest, object_id))

    def _suggest(self, object_id: str) -> None:
        session, latest = self._sessions[object_id], self._collector.latest(object_id)
        if latest is None or not self._collector.tool.radius or self._is_pushing:
            return
        settings = PushSettings(pusher_radius=self._collector.tool.radius)
        others = self._collector.outlines_of_others(object_id)
        n = self._settings["suggest_candidates"]
        suggestion = session.suggest(latest[1], settings, others, n_candidates=n, is_wanted=lambda: not self._is_pushing)
        if suggestion is not None:
            self._outputs[object_id].publish_next_push(*suggestion, session.status)
            self._counts["pushes suggested"] += 1

    def _publish_map(self, session: ObjectSession, stamp: float, n_pushes: int) -> None:
        latest = self._collector.latest(session.object_id)
        self._outputs[session.object_id].publish_map(session.posterior, stamp, session.status, n_pushes, latest[1] if latest else None)

    def _publish_model(self, session: ObjectSession, stamp: float) -> None:
        self._answered[session.object_id] = stamp
        self._outputs[session.object_id].publish_model(session.posterior, stamp, session.n_pushes, not session.is_new)

    # ---- services

    def _chosen(self, object_id: str) -> ObjectSession:
        known = sorted(self._sessions)
        if not object_id and len(known) == 1:
            return self._sessions[known[0]]
        if object_id in self._sessions:
            return self._sessions[object_id]
        raise InputError(f"There is no object `{object_id}`; known: {', '.join(known) or 'none, is perception running?'}.")

    def _predict_push(self, request: PredictPush.Request, response: PredictPush.Response) -> PredictPush.Response:
        session = self._chosen(request.object_id)
        latest, covariance = self._collector.latest(session.object_id), None
        if request.object_pose.header.frame_id:
            position_from_msg(request.object_pose)  # refuses another frame
            pose = planar_pose_of(request.object_pose.pose)
        elif request.object_pose.pose != type(request.object_pose.pose)():
            raise InputError("`object_pose` has no frame_id, expected `table`; name it, or leave the pose out for the latest observed one.")
        elif latest is not None:
            _, pose, covariance = latest
            if covariance is None:
                raise InputError(
                    f"Object `{session.object_id}`: {self._collector.lacking_covariance(session.object_id)}; wait, or give `object_pose`."
                )
        else:
            raise InputError(f"Object `{session.object_id}` has no pose yet; give `object_pose`.")
        path = pusher_path_from_msg(request.pusher_path, self._collector.tool)
        prediction = predict(session.posterior, PushScenario(path, pose, path.time), first_covariance=covariance)
        response.prediction = self._outputs[session.object_id].publish_prediction(prediction, session.status, 0)
        response.success, response.message = True, prediction.status.value
        return response

    def _save_model(self, request: SaveModel.Request, response: SaveModel.Response) -> SaveModel.Response:
        session, path = self._chosen(request.object_id), file_to_write(request.path)
        save_model(path, session.posterior, object_id=session.object_id, sources=session.sources, status=session.status)
        response.success, response.message = True, f"object {session.object_id} written to {path}"
        return response

    def _load_model(self, request: LoadModel.Request, response: LoadModel.Response) -> LoadModel.Response:
        in_file, posterior = load_model(file_to_read(request.path))
        session = self._chosen(request.object_id or in_file)
        with self._solving:
            session.adopt(posterior, request.path)
        self._publish_map(session, max(self._collector.now, 0.0), 0)
        self._publish_model(session, self._answered.get(session.object_id, 0.0))
        response.success, response.message = True, f"object {session.object_id} taken from {request.path}"
        return response

    def _load_diagnosis(self, request: LoadModel.Request, response: LoadModel.Response) -> LoadModel.Response:
        usable = usable_effects_of_file(file_to_read(request.path)) if request.path else UsableEffects((), frozenset(), 1)
        object_id = self._use_effects(request.object_id, usable, math.inf)
        names = ", ".join(effect.name for effect in usable.effects) or "no effect"
        response.success, response.message = True, f"object {object_id} has {names} of a diagnosis in its model"
        return response

    # ---- health

    def health(self) -> Health:
        overload, load = self._collector.overload()
        values = self._collector.report() | load
        missing = self._collector.what_is_missing() or overload
        pushes = {object_id: session.n_pushes for object_id, session in list(self._sessions.items())}
        failed = [f"object {s.object_id}: {s.failure}" for s in list(self._sessions.values()) if s.failure]
        if missing or failed:
            level, text = DiagnosticStatus.WARN, missing or failed[0]
        elif not values.get("pusher samples"):
            level, text = DiagnosticStatus.OK, "waiting for a push: nothing on pusher/pose yet"
        else:
            level, text = DiagnosticStatus.OK, f"pushes by object: {pushes}"
        values |= {
            "kernels": "loaded" if self._is_loaded.is_set() else "loading",
            "streams": "at rest" if self._collector.is_at_rest else "running",
            "pushes waiting": self._collector.n_ended + self._queue.n_waiting(Kind.PUSH),
            "outlines waiting": self._queue.n_waiting(Kind.OUTLINE),
        }
        values |= {"last solve [s]": f"{self._solve_time:.3f}"}
        used = {object_id: effects_text(session.posterior) for object_id, session in list(self._sessions.items())}
        values |= {f"{object_id}: diagnosed effects": text for object_id, text in used.items() if text}
        for object_id, session in list(self._sessions.items()):
            record = session.record.summary
            if record.n:
                values[f"{object_id}: predicted before, mean error [m]"] = f"{record.mean_cell_error:.5f}"
                values[f"{object_id}: within the 90 % region"] = f"{record.share_within_90:.2f} of {record.n}"
        if self._latencies:
            median, late = np.quantile(list(self._latencies), [0.5, 0.99])
            values["update latency, median [s]"], values["update latency, 99 % [s]"] = f"{median:.4f}", f"{late:.4f}"
        return Health(level, text, values)
