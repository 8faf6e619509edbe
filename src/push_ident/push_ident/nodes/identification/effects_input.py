"""Effects that were diagnosed, for the models of identification: from the topic `gap_report`, or from a file of a diagnosis."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from push_ident.diagnosis.usable_effects import UsableEffects, usable_effects_of_file, usable_effects_of_text
from push_ident.errors import InputError
from push_ident.limits import plain_text
from push_ident.nodes.base.cell_node import LATCHED, CellNode
from push_ident.nodes.base.parameters import Parameter
from push_ident.nodes.base.paths import file_to_read
from push_ident.nodes.convert.messages import stamp_from_msg
from push_ident_msgs.msg import GapReport
from push_ident_msgs.srv import LoadModel

__all__ = ["USE_DIAGNOSIS", "EffectsInput"]

USE_DIAGNOSIS: Final = Parameter(
    "use_diagnosis",
    True,
    "Whether effects that gap_diagnosis_node names with enough probability join the model of the object, with their values",
)
_NONE: Final = UsableEffects((), frozenset(), 1)


class EffectsInput:
    """Hands on what diagnoses say of a model.

    Args:
        node: with the parameter `USE_DIAGNOSIS`.
        later: takes what a report says, to be used after the work that waits: id of the object, effects, end of its newest push [s].
        now: uses what a file says at once and gives the id of the object; empty: the only one. Raises where it cannot.
    """

    def __init__(
        self, node: CellNode, later: Callable[[str, UsableEffects, float], None], now: Callable[[str, UsableEffects, float], str]
    ) -> None:
        self._node, self._later, self._now = node, later, now
        node.create_subscription(GapReport, "gap_report", self._on_report, LATCHED)
        node.create_service(LoadModel, "load_diagnosis", self._load)

    def _on_report(self, msg: GapReport) -> None:
        if not self._node.settings[USE_DIAGNOSIS.name]:
            return
        if not msg.object_id:
            raise InputError("The report names no object; its `object_id` is empty.")
        usable = usable_effects_of_text(msg.json, f"gap_report of `{plain_text(msg.object_id)}`")
        self._later(msg.object_id, usable, stamp_from_msg(msg.header.stamp))

    def _load(self, request: LoadModel.Request, response: LoadModel.Response) -> LoadModel.Response:
        usable = usable_effects_of_file(file_to_read(request.path)) if request.path else _NONE
        object_id = self._now(request.object_id, usable, math.inf)
        names = ", ".join(effect.name for effect in usable.effects) or "no effect"
        response.success, response.message = True, f"object {object_id} has {names} of a diagnosis in its model"
        return response
