"""The models that identification publishes."""

from __future__ import annotations

from functools import partial

from rclpy.callback_groups import CallbackGroup

from push_ident.identification.results.known_effects import effects_text
from push_ident.nodes.base.cell_node import LATCHED, CellNode
from push_ident.nodes.convert.model import posterior_from_msg
from push_ident.nodes.input.discovery import ObjectTopics
from push_ident.planning.goal_ports import KnownModel
from push_ident_msgs.msg import ModelPosterior

__all__ = ["ModelInput"]


class ModelInput:
    """The latest model of every object; a message that cannot be used does not replace the one before."""

    def __init__(self, node: CellNode, callback_group: CallbackGroup) -> None:
        self._node, self._group = node, callback_group
        self._models: dict[str, KnownModel] = {}
        self._effects: dict[str, str] = {}
        self._topics = ObjectTopics(node, self._subscribe, callback_group=callback_group)

    def get(self, object_id: str) -> KnownModel | None:
        """The model of an object; None before one was published."""
        return self._models.get(object_id)

    def n_pushes(self) -> dict[str, int]:
        """Pushes in the model of each object."""
        return {object_id: model.n_pushes for object_id, model in sorted(self._models.items())}

    def effects(self) -> dict[str, str]:
        """Diagnosed effects in the model of each object that has some, with their values."""
        return {object_id: text for object_id, text in sorted(self._effects.items()) if text}

    def _subscribe(self, object_id: str) -> None:
        self._node.create_subscription(
            ModelPosterior, f"objects/{object_id}/model", partial(self._on_model, object_id), LATCHED, callback_group=self._group
        )

    def _on_model(self, object_id: str, msg: ModelPosterior) -> None:
        stamp, posterior = posterior_from_msg(msg)
        self._effects[object_id] = effects_text(posterior)
        self._models[object_id] = KnownModel(posterior, stamp, int(msg.n_pushes), bool(msg.is_known))
