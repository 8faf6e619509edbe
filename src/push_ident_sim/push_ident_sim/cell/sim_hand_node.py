"""A simulated Robotiq 3-finger hand: answers the registers of its driver as the real one does, and moves nothing."""

from __future__ import annotations

import time
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType

from push_ident.nodes.base.cell_node import CellNode, Component, Health
from push_ident.nodes.base.parameters import Parameter
from push_ident.pushing.hand import CLOSED, HandMotion
from push_ident_msgs.msg import HandCommand, HandStatus

PARAMETERS: Final = (
    Parameter("closed", True, "whether the hand starts as a closed fist; else it starts in reset", read_only=True),
    Parameter("activation_time", 1.0, "from the command to an activated hand [s]", 0.0, 30.0),
    Parameter("closing_time", 1.0, "from open to closed [s]", 0.0, 30.0),
    Parameter("fault", 0, "fault code that the hand reports; 0: none", 0, 15),
)


class SimHandNode(CellNode):
    """Takes `Robotiq3FGripper/OutputRegisters`, publishes `Robotiq3FGripper/InputRegisters`."""

    yields = False

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("sim_hand_node", PARAMETERS, **kwargs)

    def make_component(self) -> Component:
        """The hand."""
        return _SimHand(self)


class _SimHand(Component):
    def __init__(self, node: CellNode) -> None:
        self._settings = node.settings
        closed = self._settings["closed"]
        self._command = HandCommand(r_act=int(closed), r_gto=int(closed), r_pra=CLOSED if closed else 0)
        self._position = float(self._command.r_pra)
        self._activation_left = 0.0 if closed else self._settings["activation_time"]
        self._looked = time.monotonic()
        self._publisher = node.create_publisher(HandStatus, "Robotiq3FGripper/InputRegisters", 10)
        node.create_subscription(HandCommand, "Robotiq3FGripper/OutputRegisters", self._on_command, 1)
        # As often as the Modbus driver polls.
        node.create_timer(0.1, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def resume(self) -> None:
        """Move from here on."""
        self._looked = time.monotonic()

    def health(self) -> Health:
        """What the fingers do."""
        return Health(DiagnosticStatus.OK, f"position {self._position:.0f} of {CLOSED}", {"activated": self._command.r_act})

    def _on_command(self, msg: HandCommand) -> None:
        if not msg.r_act:
            self._activation_left = self._settings["activation_time"]
        self._command = msg

    def _tick(self) -> None:
        now = time.monotonic()
        step, self._looked = now - self._looked, now
        command, motion = self._command, HandMotion.ARRIVED
        if command.r_act:
            self._activation_left = max(0.0, self._activation_left - step)
        is_ready = bool(command.r_act) and self._activation_left == 0.0
        goes = is_ready and bool(command.r_gto)
        if goes and self._position != command.r_pra:
            reach = CLOSED * step / max(self._settings["closing_time"], 1e-3)
            self._position += min(max(command.r_pra - self._position, -reach), reach)
            motion = HandMotion.MOVING
        self._publisher.publish(
            HandStatus(
                g_act=int(command.r_act),
                g_mod=int(command.r_mod),
                g_gto=int(goes),
                g_imc=3 if is_ready else int(command.r_act),
                g_sta=int(motion),
                g_flt=int(self._settings["fault"]),
                g_pra=int(command.r_pra),
            )
        )
