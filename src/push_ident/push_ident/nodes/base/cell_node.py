"""The base of every node: parameters, lifecycle, the guard around its callbacks, and its status in /diagnostics."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile

from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.nodes.base.arrivals import Arrivals
from push_ident.nodes.base.guard import Guard, is_guarded, refusal
from push_ident.nodes.base.parameters import Parameter, Parameters
from push_ident.nodes.base.settings import NODE

LATCHED: Final = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Of topics whose latest message is valid until the next one: later subscriptions receive it as well."""
AUTOSTART: Final = Parameter("autostart", True, "Configure and activate at start, without a lifecycle manager", read_only=True)
"""A parameter of every node."""
_DONE: Final = TransitionCallbackReturn.SUCCESS


@dataclass(frozen=True, slots=True)
class Health:
    """What a component reports of itself."""

    level: bytes
    """DiagnosticStatus.OK, WARN or ERROR."""
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class Component(ABC):
    """What a configured node has: its topics, services, actions and threads, made in the constructor.

    The node withdraws the topics, services, actions and timers of a component itself.
    """

    def resume(self) -> None:  # noqa: B027
        """Work: the node becomes active. Raises PushIdentError where it cannot."""

    def pause(self) -> None:  # noqa: B027
        """Stop working, within a second: the node becomes inactive. From now on only latched topics and services are handled."""

    def close(self) -> None:  # noqa: B027
        """Stop threads, give back what is held; never called while a callback of the component runs. The component is not used again."""

    def reconfigure(self, changed: dict[str, Any]) -> None:  # noqa: B027
        """New values of parameters that were accepted."""

    @abstractmethod
    def health(self) -> Health:
        """Its status, once a second."""


class _Gate:
    """Lets callbacks through to a component while it exists, and knows when the last one has left it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._inside = 0
        self._is_open = True
        self.is_active = False

    @contextmanager
    def enter(self) -> Iterator[bool]:
        """Whether the component may be used."""
        with self._changed:
            is_open = self._is_open
            self._inside += is_open
        try:
            yield is_open
        finally:
            with self._changed:
                self._inside -= is_open
                self._changed.notify_all()

    def close(self, timeout: float) -> bool:
        """Admit no more callbacks and wait for those inside, at most `timeout` [s]; whether all have left."""
        with self._changed:
            self._is_open = False
            return self._changed.wait_for(lambda: self._inside == 0, timeout)


class CellNode(LifecycleNode, ABC):
    """A lifecycle node that is hard to break.

    - A component is made on configure and closed on cleanup, shutdown or error; between them it is resumed and paused. An inactive node
      handles latched topics and services only. With `autostart` all happens in the constructor.
    - Every transition by service is answered, also one that does not exist or is not possible now. After `shutdown` the node answers, and
      reports itself as finalized, until its process is ended.
    - Every callback goes through `guard`, because the functions that make entities wrap it.
    - Its status goes to /diagnostics, with the number of refusals and the last one.
    """

    n_threads: ClassVar[int] = 1
    """Of the executor of its process."""
    yields: ClassVar[bool] = True
    """Whether it gives way to the nodes that move the arm, where processors are short."""
    in_turn: ClassVar[bool] = False
    """Whether a message of each topic is taken in turn, so that none waits behind many of another; else in order of arrival, which takes
    less of the processor."""
    switch_interval: ClassVar[float] = 5e-3
    """Longest time that a thread keeps the interpreter while others wait [s]; 5 ms are Python's default."""

    def __init__(
        self,
        name: str,
        parameters: Iterable[Parameter],
        *,
        further: Callable[[dict[str, Any]], Iterable[Parameter]] | None = None,
        check: Callable[[dict[str, Any]], object] | None = None,
        **kwargs: Any,
    ) -> None:
        """Arguments as those of `Parameters`; further ones go to rclpy.

        Raises PushIdentError where a parameter is refused, or the component cannot be made and activated with `autostart`.
        """
        self.guard = Guard(self.get_logger, lambda: bool(self.context.ok()))
        self._gate: _Gate | None = None
        self._component: Component | None = None
        self._fault = ""
        self._transition = threading.RLock()
        super().__init__(name, **kwargs)
        transition_group = MutuallyExclusiveCallbackGroup()
        for service in self.services:
            if not is_guarded(service.callback):
                service.callback = self.guard.service(service.srv_name, service.callback)
        change = self._service_change_state
        change.callback = self.guard.service(change.srv_name, self._on_change_state)
        # The callbacks of the component must not wait for a transition that waits for them.
        change.callback_group = transition_group
        transition_group.add_entity(change)
        self.settings = Parameters(self, (*parameters, AUTOSTART), further=further, check=check, on_change=self._on_parameters)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(NODE.report_period, self.report, callback_group=MutuallyExclusiveCallbackGroup(), clock=wall)
        self._base_entities = set(self._entities())
        if self.settings["autostart"]:
            for trigger in (self.trigger_configure, self.trigger_activate):
                if trigger() != _DONE:
                    raise InputError(self._fault)

    @abstractmethod
    def make_component(self) -> Component:
        """The component; raises PushIdentError where the parameters or the machine do not allow it."""

    @property
    def component(self) -> Any:
        """The component of a configured node, else None."""
        return self._component

    def close(self) -> None:
        """End the component: the process ends."""
        self._release()

    # ---- lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make the component."""
        with self._transition:
            self._gate = _Gate()
            try:
                self._component = self.make_component()
            except Exception as error:
                self._fault = self.guard.explain(error)
                self.get_logger().error(f"cannot be configured: {plain_text(self._fault)}")
                self._release()
                return TransitionCallbackReturn.FAILURE
            return _DONE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the component work."""
        with self._transition:
            assert self._component is not None and self._gate is not None
            try:
                self._component.resume()
            except Exception as error:
                self._fault = self.guard.explain(error)
                self.get_logger().error(f"cannot be activated: {plain_text(self._fault)}")
                return TransitionCallbackReturn.FAILURE
            self._gate.is_active = True
            return _DONE

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let the component rest."""
        with self._transition:
            self._pause()
            return _DONE

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Withdraw the component: for good at shutdown; else the node can be configured again."""
        self._release()
        return _DONE

    on_shutdown = on_error = on_cleanup

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        wanted, state = request.transition, self._state_machine.current_state[1]
        possible = {number: label for number, label, *_ in self._state_machine.available_transitions}
        # As in rclcpp, a label counts before a number.
        matching = [number for number, label in possible.items() if (label == wanted.label if wanted.label else number == wanted.id)]
        triggers = {
            Transition.TRANSITION_CONFIGURE: self.trigger_configure,
            Transition.TRANSITION_CLEANUP: self.trigger_cleanup,
            Transition.TRANSITION_ACTIVATE: self.trigger_activate,
            Transition.TRANSITION_DEACTIVATE: self.trigger_deactivate,
        }
        if not matching:
            names = ", ".join(f"{label} ({number})" for number, label in possible.items()) or "none; end the process and start it again"
            raise InputError(f"transition {wanted.label or wanted.id!r} is not possible in state {state}; possible: {names}.")
        triggers.setdefault(matching[0], self.trigger_shutdown)
        response.success = triggers[matching[0]]() == _DONE
        self.get_logger().info(f"{possible[matching[0]]}: {state} -> {self._state_machine.current_state[1]}")
        self.report()
        return response

    def _pause(self) -> None:
        if self._gate is None or self._component is None or not self._gate.is_active:
            return
        self._gate.is_active = False
        with self.guard.watch("deactivate"):
            self._component.pause()

    def _release(self) -> None:
        """Pause, wait for callbacks, close, and withdraw everything that was made since configure began."""
        with self._transition:
            self._pause()
            if self._gate is not None and not self._gate.close(NODE.drain):
                self.guard.refuse("cleanup", f"a callback has not ended within {NODE.drain} s; it is left behind")
            if self._component is not None:
                with self.guard.watch("cleanup"):
                    self._component.close()
            self._gate = self._component = None
            self._withdraw()

    def _withdraw(self) -> None:
        entities = [entity for entity in self._entities() if entity not in self._base_entities]
        if any(isinstance(entity, ActionServer) for entity in entities):
            time.sleep(NODE.answer_delay)
        for entity in entities:
            if isinstance(entity, ActionServer):
                with self.guard.watch("cleanup"):
                    entity.destroy()
        # Through the node, which forgets them first: an executor that still finds a destroyed one fails.
        for destroy, known in (
            (self.destroy_timer, self.timers),
            (self.destroy_subscription, self.subscriptions),
            (self.destroy_service, self.services),
            (self.destroy_client, self.clients),
            (self.destroy_publisher, self.publishers),
        ):
            for entity in set(known) & set(entities):
                destroy(entity)

    def _entities(self) -> Iterator[Any]:
        for entities in (self.waitables, self.timers, self.services, self.clients, self.publishers):
            yield from entities
        # That of simulated time comes and goes with the parameter use_sim_time.
        yield from (subscription for subscription in self.subscriptions if subscription.topic_name != "/clock")

    # ---- entities

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, *, arrivals: Arrivals | None = None, **kwargs: Any
    ) -> Any:
        """As of rclpy, guarded. An inactive node drops the messages, unless their topic is latched: those come only once.

        With `arrivals`, what the queue of the subscription loses is counted.
        """
        gate, source = self._gate, self.resolve_topic_name(topic)
        is_latched = isinstance(qos_profile, QoSProfile) and qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL

        def gated(message: Any) -> None:
            if gate is None:
                callback(message)
                return
            with gate.enter() as is_open:
                if is_open and (is_latched or gate.is_active):
                    callback(message)

        events = kwargs.get("event_callbacks")
        for name, event in vars(events).items() if events is not None else ():
            if callable(event):
                setattr(events, name, self.guard.callback(source, event))
        guarded = self.guard.callback(source, gated) if arrivals is None else self.guard.noted(source, gated, arrivals.note)
        return super().create_subscription(msg_type, topic, guarded, qos_profile, **kwargs)

    def arrivals_of(self, topic: str) -> Arrivals:
        """A count of what a subscription to this topic loses, for `create_subscription`."""
        name = self.resolve_topic_name(topic)
        return Arrivals(lambda: self.count_publishers(name))

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, **kwargs: Any) -> Any:
        """As of rclpy, guarded: every request is answered, also by a node that is not active."""
        gate, source = self._gate, self.resolve_service_name(srv_name)

        def gated(request: Any, response: Any) -> Any:
            if gate is None:
                return callback(request, response)
            with gate.enter() as is_open:
                if is_open:
                    return callback(request, response)
            return refusal(request, response, "the node has been cleaned up; configure and activate it")

        return super().create_service(srv_type, srv_name, self.guard.service(source, gated), **kwargs)

    def create_timer(self, timer_period_sec: float, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """As of rclpy, guarded. Timers of a component run while the node is active."""
        gate = self._gate

        def gated() -> None:
            if gate is None:
                callback()
                return
            with gate.enter() as is_open:
                if is_open and gate.is_active:
                    callback()

        source = f"timer {getattr(callback, '__name__', '')}".strip()
        return super().create_timer(timer_period_sec, self.guard.callback(source, gated), *args, **kwargs)

    def create_action_server(
        self,
        action_type: Any,
        name: str,
        execute: Callable[[ServerGoalHandle], Any],
        *,
        failed: Callable[[str], Any],
        accept: Callable[[Any], bool] = lambda request: True,
        callback_group: CallbackGroup,
    ) -> ActionServer:
        """An action whose goals may be cancelled at any time.

        A goal that cannot be carried out is accepted and aborted at once: only so the client gets the reason, in the result that `failed`
        makes of it. `accept` rejects without a reason.
        """
        gate, source = self._gate, self.resolve_topic_name(name)
        assert gate is not None

        def refuse(goal: ServerGoalHandle, why: str) -> Any:
            self.guard.refuse(source, why)
            with self.guard.watch(source):
                if goal.is_active:
                    goal.abort()
            return failed(plain_text(why))

        def gated(goal: ServerGoalHandle) -> Any:
            with gate.enter() as is_open:
                if not is_open or not gate.is_active:
                    return refuse(goal, "the node is not active; activate it")
                try:
                    return execute(goal)
                except Exception as error:
                    return refuse(goal, self.guard.explain(error))

        return ActionServer(
            self,
            action_type,
            name,
            self.guard.callback(source, gated),
            goal_callback=self.guard.callback(source, lambda request: GoalResponse.ACCEPT if accept(request) else GoalResponse.REJECT),
            handle_accepted_callback=self.guard.callback(source, lambda goal: goal.execute()),
            cancel_callback=self.guard.callback(source, lambda goal: CancelResponse.ACCEPT),
            callback_group=callback_group,
        )

    # ---- parameters and health

    def _on_parameters(self, changed: dict[str, Any]) -> None:
        with self.guard.watch("parameters"):
            if self._component is not None:
                self._component.reconfigure(changed)

    def report(self) -> None:
        """Publish the status now, as is done once a second."""
        if not self._transition.acquire(blocking=False):
            return  # Between two states there is none to report.
        try:
            health = self._health()
        finally:
            self._transition.release()
        status = DiagnosticStatus(level=health.level, name=self.get_fully_qualified_name(), hardware_id="push_ident")
        status.message = plain_text(health.message)
        values = {**health.values, "state": self._state_machine.current_state[1], **self.guard.values()}
        status.values = [KeyValue(key=plain_text(str(key)), value=plain_text(str(value))) for key, value in values.items()]
        msg = DiagnosticArray(status=[status])
        msg.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(msg)

    def _health(self) -> Health:
        number, label = self._state_machine.current_state
        try:
            health = self._component.health() if self._component is not None else Health(DiagnosticStatus.WARN, "")
        except Exception as error:
            why = self.guard.explain(error)
            self.guard.refuse("health", why)
            health = Health(DiagnosticStatus.ERROR, why)
        if number == State.PRIMARY_STATE_ACTIVE:
            return health
        what = {
            State.PRIMARY_STATE_UNCONFIGURED: self._fault or "configure and activate the node",
            State.PRIMARY_STATE_INACTIVE: "messages are ignored; activate the node",
            State.PRIMARY_STATE_FINALIZED: "shut down; end the process and start it again",
        }
        return Health(DiagnosticStatus.WARN, f"{label}: {what.get(number, 'a transition is under way')}", health.values)
