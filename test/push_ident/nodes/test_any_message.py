"""Every node as a real process under changed messages, bytes and requests: it lives, answers and writes no traceback."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from builtin_interfaces.msg import Time
from hypothesis import example, given
from hypothesis import strategies as st
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock

from helpers.fuzzing import fuzzed
from helpers.fuzzing.messages import bytes_like, message_class, messages_like
from helpers.fuzzing.right import OBJECT, right_goals, right_messages
from helpers.node_process import NodeProcess, Talker, node_commands
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.executables import NODES
from push_ident_msgs.srv import SaveModel
from push_ident_sim.executables import NODES as SIM_NODES

pytestmark = pytest.mark.live

EXAMPLES = 100
"""For each node; `make fuzz` sends many more."""
MORE_MEMORY = 400.0
"""A node may hold so much more than before [MB]: limits of what it keeps, and what the allocator keeps of large messages."""
LONGEST = 30.0
"""A node answers within this [s]; far more than it takes, as others may share the machine."""
PROBED = 8
"""Messages between two questions that the node must answer."""
NOT_FUZZED = ("/get_type_description", "/change_state")
"""Of the services: the second one may end the work of a node; `test_lifecycle.py` asks for every transition."""
LATE = "/get_result"
"""A service that answers when something else has ended."""

Target = tuple[str, bool, Any]
"""Topic or service, whether it is a service, and its class."""


def changed(name: str, change: Callable[[Any], object]) -> Any:
    msg = copy.deepcopy(right_messages()[name])
    change(msg)
    return msg


def with_stamp(name: str, sec: int, nanosec: int = 0) -> Any:
    return changed(name, lambda msg: setattr(msg.header, "stamp", Time(sec=sec, nanosec=nanosec)))


def bent(msg: Any) -> None:
    msg.poses[0].pose.orientation.y = -math.inf


# Every one of them once ended a node, or kept it from its work.
POSE, PUSHER = f"objects/{OBJECT}/pose", "pusher/pose"
FAILED_ONCE: tuple[tuple[str, Any], ...] = (
    ("joint_states", changed("joint_states", lambda msg: setattr(msg, "position", [-1e300] * len(msg.position)))),
    ("push_record", with_stamp("push_record", 0)),
    *((topic, with_stamp(topic, 2**31 - 1, nanosec)) for nanosec in (0, 10**8, 2 * 10**8) for topic in (POSE, PUSHER)),
    ("clock", Clock(clock=Time(sec=-5))),
    (f"objects/{OBJECT}/prediction", changed(f"objects/{OBJECT}/prediction", bent)),
    ("save_model", SaveModel.Request(object_id=OBJECT)),
    ("set_parameters", SetParameters.Request(parameters=[Parameter(name="use_sim_time", value=ParameterValue(type=255, bool_value=True))])),
)


class Fuzzed:
    """A node process, and what it listens to."""

    def __init__(self, name: str, process: NodeProcess, talker: Talker) -> None:
        self.name, self.process, self.talker = name, process, talker
        self._clients: dict[str, Any] = {}
        self._probe = talker.node.create_client(ListParameters, f"{name}/list_parameters")
        self._n_sent = 0
        self.probe(240.0)
        for topic, msg in right_messages().items():  # a node looks for objects by the topics that there are
            talker.publish(type(msg), topic.removeprefix("/"), msg)
        talker.until(lambda: talker.values(name), timeout=60.0)

    def probe(self, patience: float = LONGEST) -> None:
        """It runs and answers, behind all messages that wait."""
        assert self.process.runs, self.process.output[-2000:]
        self.talker.ask(self._probe, ListParameters.Request(prefixes=["use_sim_time"]), patience)

    def targets(self) -> dict[str, Target]:
        """By name: all that it subscribes to and serves, parts of its actions included."""
        node, found = self.talker.node, dict[str, Target]()
        topics = node.get_subscriber_names_and_types_by_node(self.name, "/")
        services = node.get_service_names_and_types_by_node(self.name, "/")
        for is_service, names in ((False, topics), (True, services)):
            for name, (kind, *_) in names:
                *namespaces, last = kind.split("/")
                if not name.endswith(NOT_FUZZED):
                    found[name.removeprefix("/")] = (name.removeprefix("/"), is_service, message_class(namespaces, last))
        return found

    def send(self, target: Target, content: Any) -> None:
        """A message, bytes in place of one, or a request, which it must answer."""
        to, is_service, kind = target
        if not is_service:
            try:
                data = content if isinstance(content, bytes) else serialize_message(content)
                self.talker.publish(kind, to, data)
            except (RuntimeError, rclpy_implementation.RCLError):
                return  # nobody can send what cannot be written, or is longer than DDS takes
        else:
            if to not in self._clients:
                self._clients[to] = self.talker.node.create_client(kind, to)
                self.talker.until(self._clients[to].service_is_ready, timeout=LONGEST)
                self.probe()  # so that it knows the client when the request comes
            future = self._clients[to].call_async(content)
            if not to.endswith(LATE):
                self.talker.until(future.done, timeout=LONGEST)
        self._n_sent += 1
        if self._n_sent % PROBED == 0:
            self.probe()

    @property
    def memory(self) -> float:
        """Resident [MB]."""
        return psutil.Process(self.process.pid).memory_info().rss / 1e6


def content_for(target: Target) -> st.SearchStrategy[Any]:
    name, is_service, kind = target
    if not is_service:
        base = right_messages().get(name) or right_messages().get(f"/{name}") or kind()
        return st.one_of(*[messages_like(base)] * 5, bytes_like(serialize_message(base)), st.just(base))
    bases = [kind.Request()]
    if name.endswith("/send_goal"):
        bases += [kind.Request(goal=goal) for goal in right_goals().get(name.partition("/")[0], ())]
    elif name.endswith(("/set_parameters", "/set_parameters_atomically")):
        bases = [kind.Request(parameters=[Parameter(name="use_sim_time", value=ParameterValue(type=1))])]
    return st.sampled_from(bases).flatmap(messages_like)


QUICK = ("push_executor_node", "identification_node")
"""Of the nodes: those that `make test` tries."""


@pytest.mark.fuzz
@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.long) for name in {**NODES, **SIM_NODES}])
def test_any_message_leaves_a_node_alive_and_answering(name: str, tmp_path: Path) -> None:
    commands, domain = node_commands(tmp_path), own_domain()
    with Talker(domain) as talker:
        process = NodeProcess(name, *commands[name], domain, tmp_path)
        try:
            node = Fuzzed(name, process, talker)
            targets, before = node.targets(), node.memory

            def send(sent: tuple[str, Any]) -> None:
                to, content = sent
                node.send(targets[to], content)

            test = given(st.sampled_from(sorted(targets)).flatmap(lambda to: st.tuples(st.just(to), content_for(targets[to]))))(send)
            for to, content in FAILED_ONCE:
                for present in {to, f"{name}/{to}"} & set(targets):
                    test = example((present, content))(test)
            fuzzed(EXAMPLES, shrink=False)(test)()
            node.probe()
            assert node.memory - before < MORE_MEMORY
        finally:
            code = process.stop()
    assert code == 0 and "Traceback" not in process.output, process.output[-3000:]
