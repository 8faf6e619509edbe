"""A bag as a recording that the viewer Rerun opens, with a blueprint: what is shown where. No node runs.

Rerun's own reader of MCAP files brings every topic, under its name: depth images, camera, frames, cells, numbers of any message. Here the
blueprint is added, and what that reader does not draw: the outline of each object at its poses, and the pusher.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.contract import Role, TopicRole
from push_ident.bags.decode import outline_of, pusher_shape_of
from push_ident.bags.opening import OpenBag, open_bag
from push_ident.bags.read_options import ReadOptions
from push_ident.errors import BagError, InputError
from push_ident.geometry.frames import TABLE_FRAME, object_frame
from push_ident.limits import plain_text

APPLICATION: Final = "push_ident_bag"
"""Of the recording in Rerun: a blueprint is of one application."""
TIMELINE: Final = "message_log_time"
"""Of Rerun's reader. Every message has a log time; latched ones may have no stamp."""
_DRAWN: Final = frozenset({Role.POSE, Role.OUTLINE, Role.PUSHER, Role.PUSHER_SHAPE})
_COLOURS: Final = ([213, 94, 0], [0, 114, 178], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233])
"""For all kinds of colour vision (Okabe and Ito)."""
_TOOL_HEIGHT: Final = 0.02
"""[m] Drawn of the pusher, around its tip: a bag has no more of it than pose and radius."""
_LIFT: Final = 0.001
"""[m] Of an outline above the cells, which would hide it."""
_TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"


def write_bag_view(path: Path, out: Path, options: ReadOptions | None = None) -> list[str]:
    """Write a bag as a recording of Rerun with its blueprint; the names of the views are returned.

    Raises BagError for anything that is no bag in MCAP, or one without a topic of the contract; InputError where `out` is a link.
    """
    import rerun

    if out.is_symlink():  # Rerun would follow it
        raise InputError(f"{plain_text(str(out))} is a link, expected a new file or one to replace.")
    options = options or ReadOptions()
    with open_bag(path) as bag:
        if any(file.suffix != ".mcap" for file in bag.files) or bag.is_message_compressed:
            raise BagError(
                f"{path}: Rerun reads bags in MCAP only; convert it first: rosbags-convert --src {path} --dst NEW --dst-storage mcap"
            )
        roles = {topic: role for topic in bag.counts() if (role := options.role_of(topic)) is not None}
        views = _views(roles)
        if not views:
            raise BagError(f"{path}: none of its topics is of the bag contract; name them with --map, or open the bag with `rerun` alone.")
        stream = rerun.RecordingStream(APPLICATION)
        stream.save(str(out), default_blueprint=_blueprint(views))
        for file in bag.files:
            stream.log_file_from_path(file)
        _draw(bag, roles, stream)
        stream.flush()
        stream.disconnect()
    return [str(view.name) for view in views]


def _draw(bag: OpenBag, roles: dict[str, TopicRole], stream: Any) -> None:
    """Objects and pusher, which Rerun's reader leaves undrawn."""
    import rerun

    wanted = [c for c in bag.topics if (c.topic in roles and roles[c.topic].role in _DRAWN) or c.msgtype == _TRANSFORMS]
    bag.register(wanted)
    poses: dict[str, list[tuple[int, str, str, Any]]] = {}
    pushers: dict[str, int] = {}
    radius, in_bag = None, set[str]()
    for connection, log_time, message in bag.messages(wanted):
        role = roles.get(connection.topic)
        if connection.msgtype == _TRANSFORMS:
            in_bag |= {transform.child_frame_id for transform in message.transforms}
            if role is not None:  # latched: it holds from the start on
                _place(
                    connection.topic, [(bag.start_ns, t.header.frame_id, t.child_frame_id, t.transform) for t in message.transforms], stream
                )
        elif role is None or role.role is Role.PUSHER:
            pushers.setdefault(connection.topic, log_time)
        elif role.role is Role.POSE:
            frames = (message.header.frame_id or TABLE_FRAME, object_frame(role.object_id))
            poses.setdefault(role.object_id, []).append((log_time, *frames, message.pose.pose))
        elif role.role is Role.PUSHER_SHAPE:
            radius = shape.reach if (shape := pusher_shape_of(message)) else radius
        elif (outline := outline_of(message.polygon)) is not None:
            line = rerun.LineStrips3D([[[*corner, _LIFT] for corner in (*outline, outline[0])]], colors=_COLOURS[2], radii=0.001)
            frame = rerun.CoordinateFrame(message.header.frame_id or object_frame(role.object_id))
            stream.log(connection.topic, line, frame, static=True)
    for topic, first in pushers.items():
        if radius is not None:
            stream.set_time(TIMELINE, timestamp=np.datetime64(first, "ns"))  # before its first pose it would be nowhere
            stream.log(topic, rerun.Cylinders3D(lengths=[_TOOL_HEIGHT], radii=[radius], colors=_COLOURS[1], fill_mode="solid"))
    for object_id, placed in poses.items():
        if object_frame(object_id) not in in_bag:  # else its frame is known, and may be known better
            placed[0] = (bag.start_ns, *placed[0][1:])
            _place(f"frames/{object_frame(object_id)}", placed, stream)


def _place(entity: str, transforms: list[tuple[int, str, str, Any]], stream: Any) -> None:
    """Frames by their log time [ns], parent, name, and Pose or Transform in it."""
    import rerun

    for log_time, parent, child, placed in transforms:
        origin, turn = (placed.translation, placed.rotation) if hasattr(placed, "rotation") else (placed.position, placed.orientation)
        stream.set_time(TIMELINE, timestamp=np.datetime64(log_time, "ns"))
        stream.log(
            entity,
            rerun.Transform3D(
                translation=[origin.x, origin.y, origin.z],
                quaternion=[turn.x, turn.y, turn.z, turn.w],
                parent_frame=parent,
                child_frame=child,
            ),
        )


def _views(roles: dict[str, TopicRole]) -> list[Any]:
    """A view for each kind of data that the bag has."""
    import rerun.blueprint as layout

    by_role: dict[Role, list[str]] = {}
    for topic, role in roles.items():
        by_role.setdefault(role.role, []).append(topic)
    views: list[Any] = []
    if any(role in by_role for role in (Role.POSE, Role.PUSHER, Role.DEPTH)):
        views.append(
            layout.Spatial3DView(
                name="Table",
                origin="/",
                spatial_information=layout.SpatialInformation(target_frame=TABLE_FRAME),
                eye_controls=layout.EyeControls3D(position=(0.75, 0.0, 0.55), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)),
            )
        )
    views += [layout.Spatial2DView(name="Depth", origin=topic, contents=[f"+ {topic}"]) for topic in by_role.get(Role.DEPTH, ())]
    for kind, name, message, path in (
        (Role.WRENCH, "Force on the object [N]", "geometry_msgs.msg.WrenchStamped", ".wrench.force"),
        (Role.POSE, "Position of the object [m]", "geometry_msgs.msg.PoseWithCovarianceStamped", ".pose.pose.position"),
    ):
        if kind in by_role:
            views.append(_curves(name, by_role[kind], f"{message}:message", path))
    return views


def _curves(name: str, topics: list[str], component: str, path: str) -> Any:
    """x and y of a vector in messages, over time."""
    import rerun
    import rerun.blueprint as layout
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    lines: dict[str, list[Any]] = {}
    for number, topic in enumerate(topics):
        lines[topic] = []
        for k, axis in enumerate("xy"):
            source = VisualizerComponentMapping(
                "Scalars:scalars", ComponentSourceKind.SourceComponent, source_component=component, selector=f"{path}.{axis}"
            )
            look = rerun.SeriesLines(colors=_COLOURS[(2 * number + k) % len(_COLOURS)], names=f"{topic} {axis}")
            lines[topic].append(look.visualizer(mappings=[source]))
    return layout.TimeSeriesView(name=name, origin="/", contents=[f"+ {topic}" for topic in topics], overrides=lines)


def _blueprint(views: list[Any]) -> Any:
    import rerun.blueprint as layout

    pictures, curves = ([view for view in views if isinstance(view, layout.TimeSeriesView) is is_curve] for is_curve in (False, True))
    rows = [layout.Horizontal(*row) for row in (pictures, curves) if row]
    return layout.Blueprint(
        layout.Vertical(*rows, row_shares=[3, 1][: len(rows)]),
        layout.TimePanel(timeline=TIMELINE, state="collapsed"),
        layout.BlueprintPanel(state="collapsed"),
        layout.SelectionPanel(state="collapsed"),
    )
