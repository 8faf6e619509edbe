"""Every lifecycle transition in every state, with those that do not exist: each is answered, and the state is the right one."""

from __future__ import annotations

from typing import Final

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

from helpers.node_process import Talker

LABELS: Final = ("configure", "activate", "deactivate", "cleanup", "create", "destroy", "transition_success", "[/x]é\n", "a" * 10_000)
"""Of transitions, asked for by name."""
NUMBERS: Final = (*range(1, 5), 0, 8, 10, 11, 12, 40, 62, 99, 254, 255)
"""Of transitions, asked for without a name."""
_SHUTDOWN: Final = {"unconfigured": 5, "inactive": 6, "active": 7}
_NAMES: Final = {1: "configure", 2: "cleanup", 3: "activate", 4: "deactivate"}
_NEXT: Final = {
    ("unconfigured", "configure"): "inactive",
    ("inactive", "activate"): "active",
    ("inactive", "cleanup"): "unconfigured",
    ("active", "deactivate"): "inactive",
}
_ORDER: Final = ("unconfigured", "inactive", "active")


class Lifecycle(Talker):
    """Asks one node of a ROS domain for transitions. A context manager."""

    def __init__(self, name: str, domain: int) -> None:
        super().__init__(domain)
        self._name = name
        self._change = self.node.create_client(ChangeState, f"{name}/change_state")
        self._get = self.node.create_client(GetState, f"{name}/get_state")

    def state(self) -> str:
        return str(self.ask(self._get, GetState.Request(), timeout=120.0).current_state.label)

    def change(self, label: str = "", number: int = 0) -> bool:
        return bool(self.ask(self._change, ChangeState.Request(transition=Transition(id=number, label=label))).success)

    def go_to(self, state: str) -> None:
        while (now := self.state()) != state:
            up = _ORDER.index(state) > _ORDER.index(now)
            towards = {("unconfigured", True): "configure", ("inactive", True): "activate", ("active", False): "deactivate"}
            assert self.change(towards.get((now, up), "cleanup")), f"{self._name} does not go from {now} to {state}; see its log"

    def exercise(self, rounds: int = 1) -> list[str]:
        """Every transition in every state, `rounds` times; what was wrong. The node is active after it."""
        faults = []
        for state in rounds * _ORDER:
            self.go_to(state)
            shutdowns = [("", number) for name, number in _SHUTDOWN.items() if name != state]
            for label, number in [*((label, 0) for label in LABELS), *(("", number) for number in NUMBERS), *shutdowns]:
                expected = _NEXT.get((state, label or _NAMES.get(number, "")))
                success, after = self.change(label, number), self.state()
                if success != (expected is not None) or after != (expected or state):
                    faults.append(f"{self._name}: {label[:40] or number} in {state}: {success}, {after}")
                if after != state:
                    self.go_to(state)
        self.go_to("active")
        return faults

    def shut_down(self) -> list[str]:
        """Shut the node down by its service, then ask for everything; what was wrong. The node cannot be used after it."""
        faults = [] if self.change("shutdown") else [f"{self._name}: shutdown is refused"]
        faults += [f"{self._name}: {label[:40]} is made after shutdown" for label in (*LABELS, "shutdown") if self.change(label)]
        faults += [f"{self._name}: {number} is made after shutdown" for number in (*NUMBERS, 5, 6, 7) if self.change(number=number)]
        return faults if self.state() == "finalized" else [*faults, f"{self._name}: {self.state()} after shutdown"]
