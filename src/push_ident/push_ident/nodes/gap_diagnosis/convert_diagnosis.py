"""From diagnoses to messages."""

from __future__ import annotations

import json
import math
from typing import Any

from geometry_msgs.msg import Point

from push_ident.nodes.convert.messages import TABLE_FRAME, stamp_to_msg
from push_ident_msgs.msg import GapEffect, GapPart, GapReport

__all__ = ["report_to_msg"]


def report_to_msg(content: dict[str, Any], object_id: str, stamp: float, n_pushes: int) -> GapReport:
    """A diagnosis as a message.

    Args:
        content: JSON of the command-line contract, see `push_ident.diagnosis.diagnosis_json.to_json`.
        object_id: of the object.
        stamp: of its newest push [s].
        n_pushes: that were diagnosed.
    """
    gap, account, proposal = content["gap"], content["account"], content["next_push"]
    low, high = (_number(value) for value in gap["shrink_interval"])
    msg = GapReport(
        object_id=object_id,
        n_pushes=int(n_pushes),
        verdict=content["verdict"],
        sentence=content["sentence"],
        confusable=list(content["confusable"]),
        before=_number(gap["before_m"]),
        after=_number(gap["after_m"]),
        noise=_number(gap["noise_m"]),
        shrink=_number(gap["shrink"]),
        shrink_low=low,
        shrink_high=high,
        more_pushes=-1 if account["more_pushes"] is None else int(account["more_pushes"]),
        ranking=[row["name"] for row in content["ranking"]],
        ranking_evidence=[_number(row["evidence"]) for row in content["ranking"]],
        ranking_smallest=[_number(row["smallest"]) for row in content["ranking"]],
        check=content["check"],
        json=json.dumps(content),
    )
    msg.header.stamp = stamp_to_msg(stamp)
    msg.header.frame_id = TABLE_FRAME
    msg.effects = [_effect_to_msg(effect) for effect in content["effects"]]
    # Parts by push are there where there are parts.
    msg.account = _account_to_msg(account) if account["per_push_m"] else []
    if account["first_push"] is not None:
        _add_first_push(msg, account["first_push"])
    if proposal is not None:
        _add_next_push(msg, proposal)
    return msg


def _account_to_msg(account: dict[str, Any]) -> list[GapPart]:
    """The parts in the order in which they are added up."""
    fixed = [(key.removesuffix("_m"), account[key], account["intervals"][key]) for key in ("noise_m", "maps_m", "model_m", "unexplained_m")]
    effects = [(name, value, account["intervals"]["effects"][name]) for name, value in account["effects"].items()]
    return [
        GapPart(name=name, mean=_number(mean), low=_number(low), high=_number(high))
        for name, mean, (low, high) in (*fixed[:-1], *effects, fixed[-1])
    ]


def _effect_to_msg(effect: dict[str, Any]) -> GapEffect:
    names = list(effect["parameters"])
    return GapEffect(
        name=effect["name"],
        parameters=names,
        values=[_number(effect["parameters"][name]) for name in names],
        std=[_number(effect["std"][name]) for name in names],
        evidence=_number(effect["evidence"]),
    )


def _add_first_push(msg: GapReport, push: dict[str, Any]) -> None:
    x, y = push["contact_point_m"]
    msg.has_first_push = True
    msg.first_contact_point = Point(x=float(x), y=float(y), z=0.0)
    msg.first_direction, msg.first_distance = float(push["direction_rad"]), float(push["distance_m"])
    msg.first_speed = float(push["speed_mps"])


def _add_next_push(msg: GapReport, proposal: dict[str, Any]) -> None:
    x, y = proposal["contact_point_m"]
    msg.has_next_push = True
    msg.next_push_between = list(proposal["between"])
    msg.next_push_mahalanobis2 = _number(proposal["distance2"])
    msg.contact_point = Point(x=float(x), y=float(y), z=0.0)
    msg.direction, msg.distance = float(proposal["direction_rad"]), float(proposal["distance_m"])
    msg.speed = float(proposal["speed_mps"])


def _number(value: float | None) -> float:
    """JSON has null where a number is not finite."""
    return math.nan if value is None else float(value)
