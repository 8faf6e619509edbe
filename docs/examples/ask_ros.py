"""What `ros2` does, where it is not installed: topics, parameters, lifecycle and services of a running cell.

python ask_ros.py nodes | topics | echo TOPIC [N] | hz TOPIC [SECONDS] | params NODE | get NODE NAME | set NODE NAME VALUE
                  | lifecycle NODE [TRANSITION] | call SERVICE [REQUEST]
"""

import importlib
import sys
import time

import rclpy
import yaml
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile

import push_ident.nodes  # noqa: F401  the network of this machine, as the nodes have it

PATIENCE = 10.0  # for the graph [s]
ANSWER = 90.0  # for an answer: the first solve of an installation compiles its kernels [s]


def ended(why, seconds=PATIENCE):
    return sys.exit(f"ask_ros: {why} within {seconds:.0f} s; is the cell running, and ROS_DOMAIN_ID the same?")


def found(node, look, what):
    """What `look` finds, once the graph has it."""
    deadline = time.monotonic() + PATIENCE
    while not (value := look()):
        rclpy.spin_once(node, timeout_sec=0.1)
        if time.monotonic() > deadline:
            ended(f"no {what}")
    return value


def answer(node, future):
    rclpy.spin_until_future_complete(node, future, timeout_sec=ANSWER)
    return future.result() if future.done() else ended("no answer", ANSWER)


def type_named(name):
    """Class of `package/msg/Name` or `package/srv/Name`."""
    package, kind, name = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def filled(message, values):
    for name, value in values.items():
        field = getattr(message, name)
        setattr(message, name, filled(field, value) if isinstance(value, dict) else type(field)(value))
    return message


def ask(node, name, kind, request):
    client = node.create_client(kind, name)
    found(node, client.service_is_ready, f"service {name}")
    return answer(node, client.call_async(request))


def listen(node, topic, on_message):
    """Subscribe with what the publisher offers, so that latched messages come too."""
    publisher = found(node, lambda: node.get_publishers_info_by_topic(topic), f"publisher of {topic}")[0]
    qos = QoSProfile(depth=10, reliability=publisher.qos_profile.reliability, durability=publisher.qos_profile.durability)
    return node.create_subscription(type_named(publisher.topic_type), topic, on_message, qos)


def main(verb="", name="", *rest):
    node = Node("ask_ros")
    if verb in ("nodes", "topics"):
        until = time.monotonic() + 2.0  # what is not there by then is not shown
        while time.monotonic() < until:
            rclpy.spin_once(node, timeout_sec=0.1)
        names = [f"{space.rstrip('/')}/{own}" for own, space in node.get_node_names_and_namespaces()]
        topics = [f"{topic} {' '.join(types)}" for topic, types in node.get_topic_names_and_types()]
        print(*sorted(set(names if verb == "nodes" else topics)), sep="\n")
    elif verb == "echo":
        messages = []
        listen(node, name, messages.append)
        for _ in range(int(rest[0]) if rest else 1):
            print(found(node, lambda: messages and [messages.pop(0)], f"message of {name}")[0])
    elif verb == "hz":
        stamps, seconds = [], float(rest[0]) if rest else 5.0
        listen(node, name, lambda _: stamps.append(time.monotonic()))
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            rclpy.spin_once(node, timeout_sec=0.1)
        print(f"{len(stamps)} messages in {seconds:g} s: {len(stamps) / seconds:.1f} Hz")
    elif verb in ("params", "get", "set"):
        client = AsyncParameterClient(node, name)
        found(node, client.services_are_ready, f"node {name}")
        if verb == "set":
            (result,) = answer(node, client.set_parameters([Parameter(rest[0], value=yaml.safe_load(rest[1]))])).results
            print("set" if result.successful else f"refused: {result.reason}")
        else:
            names = sorted(answer(node, client.list_parameters()).result.names) if verb == "params" else [rest[0]]
            for key, value in zip(names, answer(node, client.get_parameters(names)).values, strict=True):
                print(f"{key}: {parameter_value_to_python(value)}")
    elif verb == "lifecycle":
        if rest:
            request = ChangeState.Request()
            request.transition.label = rest[0]  # configure, activate, deactivate, cleanup
            print("done" if ask(node, f"{name}/change_state", ChangeState, request).success else "refused")
        print(ask(node, f"{name}/get_state", GetState, GetState.Request()).current_state.label)
    elif verb == "call":
        kind = type_named(found(node, lambda: dict(node.get_service_names_and_types()).get(name), f"service {name}")[0])
        print(ask(node, name, kind, filled(kind.Request(), yaml.safe_load(rest[0]) if rest else {})))
    else:
        sys.exit(__doc__)


rclpy.init(args=["--ros-args", "--enclave", "/push_ident/command_line"])
try:
    main(*sys.argv[1:])
finally:
    rclpy.try_shutdown()
