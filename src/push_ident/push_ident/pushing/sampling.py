"""Choice of a push: from a goal, at random over the whole outline as in the paper, or back to the middle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from push_ident.errors import PlanningError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import transform_points, wrap_angle
from push_ident.pushing.push import PushCode, PushPlan2D, PushSettings
from push_ident.pushing.tool_path import ToolPath
from push_ident.types import Float64Array, ObjectShape


def push_from_goal(
    shape: ObjectShape,
    pose_object_in_table: ArrayLike,
    contact_point_in_table: ArrayLike,
    direction: float,
    distance: float,
    speed: float,
    settings: PushSettings,
    obstacles: Sequence[Float64Array] = (),
) -> PushPlan2D:
    """Push that a goal requests, with the contact point moved to the nearest point of the outline.

    `direction` [rad] is in the table frame, `distance` [m], `speed` [m/s]; `obstacles` as in `check_push`.
    Raises PlanningError: INVALID_GOAL for numbers out of range or a direction away from the object, else as `check_push`.
    """
    point = np.asarray(contact_point_in_table, dtype=np.float64)
    for name, value in (("contact_point", point), ("direction", direction), ("distance", distance), ("speed", speed)):
        if not np.all(np.isfinite(value)):
            raise PlanningError(PushCode.INVALID_GOAL, f"{name} is {value}, expected finite numbers.")
    for name, value, largest in (("distance", distance, settings.max_distance), ("speed", speed, settings.max_speed)):
        if not 0 < value <= largest:
            raise PlanningError(PushCode.INVALID_GOAL, f"{name} is {value:.3f}, expected more than 0 and at most {largest:.3f}.")
    outline = transform_points(pose_object_in_table, shape.outline)
    heading = np.array([np.cos(direction), np.sin(direction)])
    contact, normal = _nearest_on_outline(point, outline, heading)
    inward = float(np.arctan2(-normal[1], -normal[0]))
    if abs(float(wrap_angle(direction - inward))) > settings.max_angle:
        raise PlanningError(
            PushCode.INVALID_GOAL,
            f"direction {direction:.2f} rad does not push into the object at ({contact[0]:.3f}, {contact[1]:.3f}) m; "
            f"the inward normal there is {inward:.2f} rad, stay within {settings.max_angle:.2f} rad of it.",
        )
    push = PushPlan2D(contact, contact + settings.pusher_radius * normal, float(direction), float(distance), float(speed))
    check_push(push, outline, settings, obstacles)
    return push


def push_along_path(
    shape: ObjectShape, pose_object_in_table: ArrayLike, path: ToolPath, settings: PushSettings, obstacles: Sequence[Float64Array] = ()
) -> PushPlan2D:
    """The straight beginning of a push along a path of the tool, which is in contact at the second point.

    `obstacles` as in `check_push`. Raises PlanningError: INVALID_GOAL where the tool would not touch the object there, or goes too fast;
    LIMIT and UNREACHABLE as `check_push`.
    """
    outline = transform_points(pose_object_in_table, shape.outline)
    first, second = path.position[:2]
    ahead = second - first
    direction = float(np.arctan2(ahead[1], ahead[0]))
    gap = float(signed_distance(second[None], outline)[0]) - settings.pusher_radius
    tolerance = settings.contact_tolerance
    if abs(gap) > tolerance:
        raise PlanningError(
            PushCode.INVALID_GOAL,
            f"the tool would be {1e3 * gap:.1f} mm from the object at the second point of tool_path, expected {1e3 * tolerance:.0f} "
            "at most; plan from the latest pose.",
        )
    if path.speed > settings.max_speed:
        raise PlanningError(PushCode.INVALID_GOAL, f"tool_path has {path.speed:.3f} m/s, expected {settings.max_speed:.3f} at most.")
    _check_inside(path.position, settings)
    # Until it touches, the tool keeps clear of the object, as far as its pose is known; of others all the way.
    checks = [(_line(first, second), outline, tolerance), *((path.dense(), other, settings.contact_rounding) for other in obstacles)]
    for points, other, overlap in checks:
        _check_gaps(points, signed_distance(points, other) - settings.pusher_radius, overlap, settings)
    contact, _ = _nearest_on_outline(second, outline, ahead)
    length = float(np.sum(np.linalg.norm(np.diff(path.position[1:], axis=0), axis=1)))
    return PushPlan2D(contact, np.array(second), direction, length, path.speed)


def push_with_both_ends(
    shape: ObjectShape,
    pose_object_in_table: ArrayLike,
    path: ToolPath,
    settings: PushSettings,
    obstacles: Sequence[Float64Array] = (),
    *,
    back_off: float,
) -> PushPlan2D:
    """The straight beginning of a push with both ends of a tool that turns on the way, in contact at the second point of its path.

    `obstacles` as in `check_push`; `back_off`: travel back along the x axis of the tool before it rises [m]. Of other objects the circle
    around the tool keeps clear, of this one the tool itself. Raises PlanningError: INVALID_GOAL where the tool or the path is none for it,
    or no end would touch the object there; LIMIT and UNREACHABLE as `check_push`.
    """
    if not settings.span:
        raise PlanningError(
            PushCode.INVALID_GOAL,
            "tool_path has yaws, and the tool is a cylinder; leave the yaws out, or state its finger_distance.",
        )
    outline, ends = transform_points(pose_object_in_table, shape.outline), settings.ends(path.poses)
    gap = float(np.min(signed_distance(ends[1], outline))) - settings.pusher_radius
    if abs(gap) > settings.contact_tolerance:
        raise PlanningError(
            PushCode.INVALID_GOAL,
            f"the tool would be {1e3 * gap:.1f} mm from the object at the second point of tool_path, expected "
            f"{1e3 * settings.contact_tolerance:.0f} at most; plan from the latest pose.",
        )
    speed = float(np.max(np.linalg.norm(np.diff(ends, axis=0), axis=2) / np.diff(path.time)[:, None]))
    if speed > settings.max_speed:
        raise PlanningError(PushCode.INVALID_GOAL, f"an end of the tool has {speed:.3f} m/s, expected {settings.max_speed:.3f} at most.")
    along = path.dense_poses(1e-3, 0.5 * settings.span)[1]
    _check_inside(settings.ends(along).reshape(-1, 2), settings)
    # Until it touches, all between both ends keeps clear of the object, as far as its pose is known; of others the circle all the way.
    first, second = path.poses[:2]
    approach = np.linspace(first, second, len(_line(first[:2], second[:2])))
    across = np.concatenate([_line(*pair) for pair in settings.ends(approach)])
    n_lowered, gaps = len(_line(*ends[0])), signed_distance(across, outline) - settings.pusher_radius
    _check_gaps(across, gaps, settings.contact_tolerance, settings, n_lowered)
    last = along[-1]
    circle = np.vstack([along[:, :2], _line(last[:2], last[:2] - back_off * np.array([np.cos(last[2]), np.sin(last[2])]))])
    for other in obstacles:
        _check_gaps(circle, signed_distance(circle, other) - settings.tool.reach, settings.contact_rounding, settings)
    ahead = second - first
    contact, _ = _nearest_on_outline(second[:2], outline, ahead[:2])
    length = float(np.sum(np.linalg.norm(np.diff(path.position[1:], axis=0), axis=1)))
    return PushPlan2D(contact, np.array(second[:2]), float(np.arctan2(ahead[1], ahead[0])), length, path.speed)


def _check_inside(points: Float64Array, settings: PushSettings) -> None:
    """Raise PlanningError LIMIT for axes of the tool, shape (n, 2), out of the workspace."""
    if (excess := settings.excess(points)) > 0.0:
        raise PlanningError(PushCode.LIMIT, f"tool_path leaves the workspace {settings.workspace} m by {1e3 * excess:.1f} mm.")


def _check_gaps(points: Float64Array, gaps: Float64Array, overlap: float, settings: PushSettings, n_lowered: int = 1) -> None:
    """Raise PlanningError UNREACHABLE for a tool that comes too near to an object.

    Args:
        points: along its path [m], shape (n, 2).
        gaps: there [m], shape (n,).
        overlap: that is allowed [m].
        n_lowered: the first points, at which it is lowered.
    """
    lowered = gaps[:n_lowered]
    if float(np.min(lowered)) < settings.lowering_gap or float(np.min(gaps)) < -overlap:
        k = int(np.argmin(lowered if float(np.min(lowered)) < settings.lowering_gap else gaps))
        x, y = points[k]
        raise PlanningError(
            PushCode.UNREACHABLE,
            f"on tool_path the pusher would be {1e3 * gaps[k]:.1f} mm from an object at ({x:.3f}, {y:.3f}) m; choose another contact.",
        )


def sample_push(
    shape: ObjectShape,
    pose_object_in_table: ArrayLike,
    rng: np.random.Generator,
    settings: PushSettings,
    obstacles: Sequence[Float64Array] = (),
) -> PushPlan2D:
    """Random push: contact uniform over the outline's length, direction uniform in a cone about the inward normal.

    Pushes that `check_push` refuses are drawn again, as are those that would move an object near the edge of the workspace
    further out. Raises PlanningError UNREACHABLE, with counts of the reasons, when no draw is accepted.
    """
    outline = transform_points(pose_object_in_table, shape.outline)
    refused: Counter[str] = Counter()
    for _ in range(settings.n_draws):
        contact, normal = _point_on_outline(rng.uniform(), outline)
        direction = float(wrap_angle(np.arctan2(-normal[1], -normal[0]) + rng.uniform(-settings.cone, settings.cone)))
        distance, speed = float(rng.uniform(*settings.distance_range)), float(rng.uniform(*settings.speed_range))
        push = PushPlan2D(contact, contact + settings.pusher_radius * normal, direction, distance, speed)
        if _leaves_workspace(outline, push, settings):
            refused["would push the object out of the workspace"] += 1
            continue
        try:
            check_push(push, outline, settings, obstacles)
        except PlanningError as error:
            refused["leave the workspace" if error.code == PushCode.LIMIT else "would touch an object elsewhere first"] += 1
            continue
        return push
    counts = ", ".join(f"{n} {why}" for why, n in refused.most_common())
    raise PlanningError(
        PushCode.UNREACHABLE, f"none of {settings.n_draws} random pushes is possible ({counts}); move the object to the middle."
    )


def is_near_edge(shape: ObjectShape, pose_object_in_table: ArrayLike, settings: PushSettings) -> bool:
    """Whether the outline is nearer to the edge of the workspace than `settings.edge_margin`, or outside, and a push can improve that.

    No push can move a large object in the middle of the workspace further from the edge.
    """
    to_middle = float(np.linalg.norm(settings.middle - np.asarray(pose_object_in_table, dtype=np.float64)[:2]))
    near = settings.excess(transform_points(pose_object_in_table, shape.outline), settings.edge_margin) > 0.0
    return near and to_middle > settings.distance_range[0]


def recentring_pushes(
    shape: ObjectShape, pose_object_in_table: ArrayLike, settings: PushSettings, obstacles: Sequence[Float64Array] = ()
) -> Iterator[PushPlan2D]:
    """Pushes that move the object towards the middle of the workspace, the best first; only those that pass `check_push`.

    The best push goes straight to the middle through the centroid of the outline. At a contact with another normal the direction is as near
    to that one as `settings.cone` allows, and the push ends where it is nearest to the middle. All have the lowest speed of random pushes.
    Yields nothing where no contact is within reach, or the object is in the middle.
    """
    outline = transform_points(pose_object_in_table, shape.outline)
    centroid = np.asarray(pose_object_in_table, dtype=np.float64)[:2]  # the origin of an object frame
    offset = settings.middle - centroid
    to_middle = float(np.arctan2(offset[1], offset[0]))
    size = float(np.max(np.linalg.norm(outline - centroid, axis=1)))
    candidates: list[tuple[float, PushPlan2D]] = []
    for share in (np.arange(settings.n_recentring_contacts) + 0.5) / settings.n_recentring_contacts:
        contact, normal = _point_on_outline(float(share), outline)
        inward = float(np.arctan2(-normal[1], -normal[0]))
        direction = inward + float(np.clip(wrap_angle(to_middle - inward), -settings.cone, settings.cone))
        deviation = abs(float(wrap_angle(direction - to_middle)))
        if deviation > settings.max_recentring_angle:
            continue
        distance = min(float(np.linalg.norm(offset) * np.cos(deviation)), settings.max_distance)
        if distance < 0.5 * settings.distance_range[0]:
            continue
        push = PushPlan2D(
            contact, contact + settings.pusher_radius * normal, float(wrap_angle(direction)), distance, settings.speed_range[0]
        )
        # A push that passes the centroid at a distance turns the object instead of moving it.
        across = np.array([-push.heading[1], push.heading[0]])
        candidates.append((deviation + abs(float((contact - centroid) @ across)) / size, push))
    for _, push in sorted(candidates, key=lambda candidate: candidate[0]):
        try:
            check_push(push, outline, settings, obstacles)
        except PlanningError:
            continue
        yield push


def check_push(push: PushPlan2D, outline: Float64Array, settings: PushSettings, obstacles: Sequence[Float64Array] = ()) -> None:
    """Raise PlanningError unless the lowered pusher stays in the workspace and its first contact is the planned one.

    `outline` and each of `obstacles` (outlines of the other objects) have shape (n_vertices, 2), table frame [m].
    LIMIT: the pusher's path leaves the workspace. UNREACHABLE: it would touch an object earlier.
    """
    start, end = push.tool_start(settings.clearance), push.tool_end
    rear = start - settings.span * push.heading
    x_min, x_max, y_min, y_max = settings.workspace
    for name, (x, y) in (("start", start), ("end", end), ("start", rear)):
        if not (x_min <= x <= x_max and y_min <= y <= y_max):
            raise PlanningError(
                PushCode.LIMIT,
                f"the tool at the {name} of the push, ({x:.3f}, {y:.3f}) m, leaves the workspace "
                f"x {x_min:.3f}..{x_max:.3f}, y {y_min:.3f}..{y_max:.3f}; shorten or turn the push.",
            )
    for other in (outline, *obstacles):
        gap = float(np.min(signed_distance(_line(rear, start), other))) - settings.pusher_radius
        if gap < settings.lowering_gap:
            raise PlanningError(
                PushCode.UNREACHABLE,
                f"the tool cannot be lowered at ({start[0]:.3f}, {start[1]:.3f}) m: {1e3 * gap:.1f} mm from an object, "
                f"needs {1e3 * settings.lowering_gap:.1f} mm; choose another contact or direction.",
            )
    # The rear end follows the front one.
    approach = _line(rear, push.tool_at_contact)
    sweep = np.vstack([approach, _line(push.tool_at_contact, end)])
    for path, other in ((approach, outline), *((sweep, obstacle) for obstacle in obstacles)):
        gaps = signed_distance(path, other) - settings.pusher_radius
        if float(np.min(gaps)) < -settings.contact_rounding:
            x, y = path[int(np.argmax(gaps < -settings.contact_rounding))]
            raise PlanningError(
                PushCode.UNREACHABLE,
                f"the pusher of radius {settings.pusher_radius:.3f} m would touch an object at ({x:.3f}, {y:.3f}) m, before or beside "
                "the planned contact; choose another contact or direction.",
            )


def _leaves_workspace(outline: Float64Array, push: PushPlan2D, settings: PushSettings) -> bool:
    """Whether the object, moved along the whole push, would be outside the workspace and further than before."""
    after = settings.excess(outline + push.distance * push.heading)
    return after > 0.0 and after >= settings.excess(outline)


def _line(start: Float64Array, end: Float64Array, step: float = 1e-3) -> Float64Array:
    """Points from `start` to `end`, at most `step` [m] apart, shape (n, 2)."""
    n = int(np.ceil(float(np.linalg.norm(end - start)) / step)) + 1
    return np.linspace(start, end, max(n, 2))


def _edges(outline: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Length, unit direction and outward normal of each edge of a counter-clockwise outline."""
    edge = np.roll(outline, -1, axis=0) - outline
    length = np.linalg.norm(edge, axis=1)
    along = edge / np.maximum(length, 1e-300)[:, None]
    return length, along, np.stack([along[:, 1], -along[:, 0]], axis=1)


def _point_on_outline(share: float, outline: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Point at `share` (0..1) of the outline's length, and the outward normal there."""
    length, along, normal = _edges(outline)
    ends = np.cumsum(length)
    i = min(int(np.searchsorted(ends, share * ends[-1], side="right")), len(length) - 1)
    return outline[i] + (share * ends[-1] - (ends[i] - length[i])) * along[i], normal[i]


def _nearest_on_outline(point: Float64Array, outline: Float64Array, heading: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Nearest point of the outline and its outward normal; at a corner that of the edge most opposed to `heading`."""
    length, along, normal = _edges(outline)
    travel = np.clip(np.sum((point - outline) * along, axis=1), 0.0, length)
    nearest = outline + travel[:, None] * along
    distance = np.linalg.norm(nearest - point, axis=1)
    candidates = np.flatnonzero((distance < distance.min() + 1e-9) & (length > 0))
    i = int(min(candidates, key=lambda k: float(normal[k] @ heading)))
    return nearest[i], normal[i]
