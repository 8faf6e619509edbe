"""One node under fire: batches of mutated messages between valid ones, and what the node must never do."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.serialization import serialize_message

from push_ident_sim.fuzz.arm_scene import Executor
from push_ident_sim.fuzz.bench import HANG, Bench, Interfaces, NodeFailure, Sent, granted
from push_ident_sim.fuzz.goal_scene import GoalPushing
from push_ident_sim.fuzz.mutate_message import mutate_bytes, mutate_message
from push_ident_sim.fuzz.scenes import SCENES, Scene

__all__ = ["Finding", "NodeResult", "Session", "merged", "scene_of"]

_BATCH: Final = 8
"""Mutated messages, each for another topic or service, between two questions that the node must answer."""
_REQUESTS: Final = 0.2
"""Share of requests to services among the mutated messages."""
_BYTES: Final = 0.15
"""Share of messages whose serialised bytes are mutated instead of their fields."""
_REPLAYED: Final = 0.05
"""Share of messages that were valid once: duplicates."""
_BETWEEN: Final = 0.02
"""Time between two messages that are sent again [s]."""
_WORK_EVERY: Final = 400
"""Mutated messages between two pieces of work that the node must do."""
_MORE_MEMORY: Final = 400.0
"""A node may hold so much more than after its first work [MB]: limits of what it keeps, and what the allocator keeps of large messages."""
_NOT_FUZZED: Final = ("/get_type_description",)
_SHUTDOWN: Final = (5, 6, 7)
"""Transitions that rightly end the work of a node for good."""
_PARAMETERS: Final = ("/set_parameters", "/set_parameters_atomically")


@dataclass(slots=True)
class Finding:
    """A failure of a node, with what was sent before."""

    node: str
    kind: str
    text: str
    messages: list[Sent] = field(repr=False, default_factory=list)


@dataclass(slots=True)
class NodeResult:
    """What happened to one node."""

    node: str
    seed: int
    seconds: float = 0.0
    topics: dict[str, int] = field(default_factory=dict)
    """Mutated messages by topic."""
    services: dict[str, int] = field(default_factory=dict)
    """Mutated requests by service."""
    valid: int = 0
    """Valid messages in between."""
    refused: int = 0
    """Counted by the node in its diagnostics."""
    worst_answer: float = 0.0
    """Longest time to the answer of a question behind a batch [s]."""
    memory_growth: float = 0.0
    """Largest growth since the first work [MB]."""
    works: int = 0
    """How often it was asked to do its work."""
    failures: list[dict[str, str]] = field(default_factory=list)

    @property
    def mutated(self) -> int:
        """Messages and requests."""
        return sum(self.topics.values()) + sum(self.services.values())

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self) | {"mutated": self.mutated}


def merged(results: list[NodeResult]) -> NodeResult:
    """Runs of one node together."""
    whole = NodeResult(results[0].node, results[0].seed)
    for result in results:
        for counts, more in ((whole.topics, result.topics), (whole.services, result.services)):
            for name, n in more.items():
                counts[name] = counts.get(name, 0) + n
        whole.seconds, whole.valid = whole.seconds + result.seconds, whole.valid + result.valid
        whole.refused, whole.works = whole.refused + result.refused, whole.works + result.works
        whole.worst_answer = max(whole.worst_answer, result.worst_answer)
        whole.memory_growth = max(whole.memory_growth, result.memory_growth)
        whole.failures += result.failures
    return whole


def scene_of(executable: str) -> type[Scene]:
    """What stands around a node."""
    own: dict[str, type[Scene]] = {"push_executor_node": Executor, "goal_pushing_node": GoalPushing}
    return own.get(executable) or SCENES.get(executable, Scene)


class Session:
    """Fuzzes one node until time or messages are used up, or it fails."""

    def __init__(self, executable: str, folder: Path, domain: int, seed: int) -> None:
        self.executable, self.folder, self.domain = executable, folder.absolute(), domain
        self.result = NodeResult(executable, seed)
        self._rng = random.Random(f"{seed} {executable}")
        self._restore: list[Parameter] = []

    def run(
        self,
        *,
        until: float,
        n_messages: int | None = None,
        first: list[Sent] | None = None,
        on_progress: Callable[[NodeResult], None] = lambda result: None,
    ) -> Finding | None:
        """The first failure, or None.

        Args:
            until: `time.monotonic` at which it ends [s].
            n_messages: Mutated messages after which it ends.
            first: Messages of earlier findings, sent before all others.
            on_progress: Called after each piece of work.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        kind, began = scene_of(self.executable), time.monotonic()
        with Bench(self.executable, self.folder, self.domain, kind.parameters(self.folder)) as bench:
            scene = kind(bench)
            try:
                self._begin(bench, scene)
                self.replay(bench, scene, first or [])
                self._loop(bench, scene, until, n_messages, on_progress)
                bench.stop()
            except NodeFailure as failure:
                self.result.failures.append({"kind": failure.kind, "text": str(failure)})
                return Finding(self.executable, failure.kind, str(failure), list(bench.history))
            finally:
                self._count(bench)
                self.result.seconds += time.monotonic() - began
        return None

    def replay(self, bench: Bench, scene: Scene, messages: list[Sent]) -> None:
        """Send what was sent before, then let the node work. Raises NodeFailure."""
        for sent in messages:
            if not sent.valid:
                # As it was found: in the middle of a push.
                scene.step()
                bench.spin(_BETWEEN)
            if sent.is_request:
                bench.replay_request(sent)
            else:
                bench.publish(sent.to, sent.kind, sent.data, valid=sent.valid)
            bench.probe()
            scene.check()
        if messages:
            self._work(bench, scene)

    def begin(self, bench: Bench, scene: Scene) -> None:
        """Start the node and let it work once."""
        self._begin(bench, scene)

    def _begin(self, bench: Bench, scene: Scene) -> None:
        scene.prepare()
        bench.start()
        self._restore = _parameters_of(bench)
        scene.work()
        self._baseline = bench.memory

    def _loop(self, bench: Bench, scene: Scene, until: float, n_messages: int | None, on_progress: Callable[[NodeResult], None]) -> None:
        limit = n_messages if n_messages is not None else 10**12
        interfaces, since_work = bench.interfaces(), 0
        while time.monotonic() < until and bench.sent.total() < limit:
            scene.step()
            since_work += self._batch(bench, scene, interfaces)
            self.result.worst_answer = max(self.result.worst_answer, bench.probe())
            scene.check()
            if since_work >= _WORK_EVERY:
                since_work = 0
                bench.check()
                self._work(bench, scene)
                interfaces = bench.interfaces()
                self._count(bench)
                on_progress(self.result)
        self._work(bench, scene)

    def _batch(self, bench: Bench, scene: Scene, interfaces: Interfaces) -> int:
        rng = self._rng
        topics = rng.sample(sorted(interfaces.topics), min(_BATCH, len(interfaces.topics)))
        for topic in topics:
            bench.publish(topic, kind := bench.kind_of(interfaces.topics[topic]), self._message(scene, topic, kind))
        n_requests = sum(rng.random() < _REQUESTS for _ in range(_BATCH)) if topics else 4
        services = [name for name in interfaces.services if not name.endswith(_NOT_FUZZED)]
        for service in rng.choices(services, k=n_requests) if services else ():
            kind = bench.kind_of(interfaces.services[service])
            bench.request(service, kind, self._request(scene, service, kind))
        return len(topics) + n_requests

    def _message(self, scene: Scene, topic: str, kind: Any) -> Any:
        """A mutated message, or mutated bytes."""
        rng = self._rng
        known = scene.recent.get(topic)
        base = rng.choice(known) if known else kind()
        how = rng.random()
        if how < _BYTES:
            return mutate_bytes(serialize_message(base), rng)
        return base if how < _BYTES + _REPLAYED else mutate_message(base, rng)[0]

    def _request(self, scene: Scene, service: str, kind: Any) -> Any:
        rng = self._rng
        if service.endswith(_PARAMETERS) and self._restore:
            base = kind.Request(parameters=rng.sample(self._restore, 1))
        else:
            base = rng.choice(scene.requests(service) or [kind.Request()])
        request = mutate_message(base, rng)[0]
        if kind is ChangeState:
            request = rng.choice((request, *(ChangeState.Request(transition=Transition(id=number)) for number in scene.transitions)))
            if request.transition.id not in scene.transitions and request.transition.id <= max(_SHUTDOWN):
                request.transition = Transition(id=99)
        return request

    def _work(self, bench: Bench, scene: Scene) -> None:
        """Back to an active node with its parameters and latched messages; then it must work, within its memory."""
        _activate(bench)
        bench.call(f"{bench.name}/set_parameters", SetParameters, SetParameters.Request(parameters=self._restore))
        scene.settle()
        scene.work()
        self.result.works += 1
        growth = bench.memory - self._baseline
        self.result.memory_growth = max(self.result.memory_growth, growth)
        if growth > _MORE_MEMORY:
            raise NodeFailure("memory", f"grew by {growth:.0f} MB, from {self._baseline:.0f} MB")

    def _count(self, bench: Bench) -> None:
        services = {name for name in bench.sent if name not in bench.topics_used}
        self.result.topics = {name: n for name, n in sorted(bench.sent.items()) if name not in services}
        self.result.services = {name: n for name, n in sorted(bench.sent.items()) if name in services}
        self.result.valid = bench.valid
        self.result.refused = int(bench.diagnostics.get("refused", "0"))


def _activate(bench: Bench) -> None:
    """Make a lifecycle node active again; mutated requests may have changed its state."""
    name, steps = f"{bench.name}/change_state", {State.PRIMARY_STATE_UNCONFIGURED: "configure", State.PRIMARY_STATE_INACTIVE: "activate"}
    if name not in bench.interfaces().services:
        return
    deadline = time.monotonic() + granted(HANG)
    while True:
        state = bench.call(f"{bench.name}/get_state", GetState, GetState.Request()).current_state
        if state.id == State.PRIMARY_STATE_ACTIVE:
            return
        if time.monotonic() > deadline:
            raise NodeFailure("no work", f"stays in state {state.label}; {bench.diagnostics.get('message')}")
        if state.id in steps:
            bench.call(name, ChangeState, ChangeState.Request(transition=Transition(label=steps[state.id])))
        else:
            bench.spin(0.1)  # a transition is under way


def _parameters_of(bench: Bench) -> list[Parameter]:
    """The parameters of the node with their present values."""
    names = bench.call(f"{bench.name}/list_parameters", ListParameters, ListParameters.Request()).result.names
    values = bench.call(f"{bench.name}/get_parameters", GetParameters, GetParameters.Request(names=names)).values
    return [Parameter(name=name, value=value) for name, value in zip(names, values, strict=True)]
