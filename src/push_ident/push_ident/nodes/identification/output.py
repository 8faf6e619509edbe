"""What the identification node publishes of one object."""

from __future__ import annotations

from nav_msgs.msg import Path
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.identification.predicting.prediction import Prediction
from push_ident.identification.predicting.scoring import PushScore, ScoreSummary
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.convert.messages import stamp_to_msg
from push_ident.nodes.convert.model import (
    cloud_to_msg,
    map_status,
    map_to_msg,
    markers_to_msg,
    path_to_msg,
    posterior_to_msg,
    prediction_path_to_msg,
    prediction_to_msg,
    score_to_msg,
)
from push_ident.types import Float64Array, SolveStatus
from push_ident_msgs.msg import MassFrictionMap, PushPrediction
from push_ident_msgs.msg import ModelPosterior as ModelPosteriorMsg
from push_ident_msgs.msg import PushScore as PushScoreMsg


class ObjectOutput:
    """Publishers of one object."""

    def __init__(self, node: Node, object_id: str) -> None:
        self._id = object_id
        self._map = node.create_publisher(MassFrictionMap, f"objects/{object_id}/mass_friction_map", LATCHED)
        self._model = node.create_publisher(ModelPosteriorMsg, f"objects/{object_id}/model", LATCHED)
        self._cloud = node.create_publisher(PointCloud2, f"objects/{object_id}/mass_friction_cloud", LATCHED)
        self._markers = node.create_publisher(MarkerArray, f"objects/{object_id}/markers", LATCHED)
        self._prediction = node.create_publisher(PushPrediction, f"objects/{object_id}/prediction", LATCHED)
        self._prediction_path = node.create_publisher(Path, f"objects/{object_id}/prediction_path", LATCHED)
        self._next_push = node.create_publisher(Path, f"objects/{object_id}/next_push", LATCHED)
        self._next_prediction = node.create_publisher(PushPrediction, f"objects/{object_id}/next_push_prediction", LATCHED)
        self._score = node.create_publisher(PushScoreMsg, f"objects/{object_id}/push_score", LATCHED)

    def publish_map(
        self, posterior: ModelPosterior, stamp: float, status: SolveStatus | None, n_pushes: int, pose: Float64Array | None
    ) -> None:
        """The maps; with markers where the pose of the object, shape (3,), table frame, is known."""
        msg = map_to_msg(posterior, self._id, stamp_to_msg(stamp), status, n_pushes)
        self._map.publish(msg)
        self._cloud.publish(cloud_to_msg(msg))
        if pose is not None and self._markers.get_subscription_count() > 0:
            self._markers.publish(markers_to_msg(msg, pose))

    def publish_model(self, posterior: ModelPosterior, stamp: float, n_pushes: int, is_known: bool) -> None:
        """The whole posterior, for planning; `stamp` [s] is that of the latest push that was learned or refused."""
        self._model.publish(posterior_to_msg(posterior, self._id, stamp_to_msg(stamp), n_pushes=n_pushes, is_known=is_known))

    @property
    def prediction_is_wanted(self) -> bool:
        """Whether the prediction of the current push has a subscription."""
        return bool(self._prediction.get_subscription_count() or self._prediction_path.get_subscription_count())

    def publish_prediction(self, prediction: Prediction, status: SolveStatus | None, push_id: int) -> PushPrediction:
        """Of the push under way, or in answer to a request."""
        msg = prediction_to_msg(prediction, self._id, map_status(status), push_id=push_id)
        self._prediction.publish(msg)
        self._prediction_path.publish(prediction_path_to_msg(msg))
        return msg

    def publish_next_push(self, push: PlannedPush, prediction: Prediction, status: SolveStatus | None) -> None:
        """The push to make next: path of the tool, and what it will do."""
        self._next_push.publish(path_to_msg(push.pusher))
        self._next_prediction.publish(prediction_to_msg(prediction, self._id, map_status(status)))

    def publish_score(self, score: PushScore, summary: ScoreSummary, stamp: float) -> None:
        """How well the push was predicted."""
        self._score.publish(score_to_msg(score, summary, self._id, stamp))
