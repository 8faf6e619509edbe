"""Tools that touch an object at two places, two fingers or a plate with round ends: laws of each step, and closed forms."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from helpers.random_pushes import DT, ENGINES, Case, fixed_seeds, line_tool_case, mirrored, moved, steps_of
from push_ident.errors import InputError
from push_ident.geometry.cut_cells import cells_in_outline
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.physics.batch import BatchModel, BatchPush, rollouts
from push_ident.physics.contact_rows import RECOVERY_SPEED
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import SimulationSettings, simulate
from push_ident.types import Float64Array, ObjectModel, ObjectShape, PusherPath, PusherShape, SolveStatus

LINE = np.array([[0.0, 0.012], [0.0, -0.012]])
RADIUS = 0.003
TOOLS = {"plate": {"polygon": LINE}, "fingers": {"fingers": LINE}}


def block(pusher_friction: float = 0.4, friction: float = 0.3) -> ObjectModel:
    outline = np.array([[-0.03, -0.025], [0.03, -0.025], [0.03, 0.025], [-0.03, 0.025]])
    shape = ObjectShape(cells_in_outline(outline, 0.006), outline)
    n_cells = len(shape.cells)
    return ObjectModel(shape, np.full(n_cells, 0.5 / n_cells), np.full(n_cells, friction), pusher_friction)


def cross(a: Float64Array, b: Float64Array) -> Float64Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def wrenches_of_contacts(
    case: Case, pose: Float64Array, n: int, twist: Float64Array, contacts: Float64Array
) -> tuple[list[Float64Array], str]:
    """What the contacts can exert, as generators of a cone of wrenches about the origin of the table, and what the fingers do.

    Contacts that part exert nothing; one that slides, a force on the edge of its cone against the slip; one that sticks, any in its cone.
    """
    path, mu = case.pusher, case.model.pusher_friction
    turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
    going, spin = (path.position[n + 1] - path.position[n]) / DT, (path.yaw[n + 1] - path.yaw[n]) / DT
    centre = transform_points(pose, case.body.centre[None])[0]
    pressing = []
    for contact in contacts[:2]:
        normal, point = turn @ contact[1:3], transform_points(pose, contact[3:5][None])[0]
        tool = going + spin * np.array([-(point - path.position[n])[1], (point - path.position[n])[0]])
        own = twist[:2] + twist[2] * np.array([-(point - centre)[1], (point - centre)[0]])
        closing, most = float(normal @ (own - tool)), max(contact[0] / DT, -RECOVERY_SPEED)
        assert closing <= most + 1e-9
        if closing > most - 1e-9:
            pressing.append((normal, point, own - tool, abs(most)))
    # Of four conditions of fingers that stick, three are met exactly; the closing of the gaps leaves some slip to the fourth.
    slowest = 1e-9 + (2.0 * sum(most for *_, most in pressing) if len(pressing) == 2 else 0.0)
    cone, does = [], []
    for normal, point, relative, _ in pressing:
        tangent = np.array([-normal[1], normal[0]])
        slip = float(tangent @ relative)
        drags = (-mu, mu) if abs(slip) < slowest else (-np.sign(slip) * mu,)
        does.append("sticks" if len(drags) == 2 else "slides")
        for drag in drags:
            force = -normal + drag * tangent
            cone.append(np.array([*force, cross(point, force)]))
    return cone, " and ".join(sorted(does))


@pytest.mark.parametrize("mode", ["circle", "quasi-static"])
@pytest.mark.parametrize(("tool", "on_corner"), [("plate", False), ("fingers", False), ("fingers", True)])
def test_forces_of_both_contacts_lie_in_their_cones_and_balance_every_step(tool: str, on_corner: bool, mode: str) -> None:
    count = Counter[str]()
    for seed in fixed_seeds(60):
        case = line_tool_case(seed, tool, 12, on_corner=on_corner)
        motion = case.simulate(ENGINES[mode])
        assert motion.status is SolveStatus.CONVERGED
        body = case.body
        inertia = np.zeros(3) if mode == "quasi-static" else np.array([body.mass, body.mass, body.inertia])
        for n, step in enumerate(steps_of(case, motion)):
            if not step.force.any():
                continue
            cells = step.twist[:2] + step.twist[2] * np.column_stack([-step.arms[:, 1], step.arms[:, 0]])
            friction = DT * body.limit[:, None] * cells / np.sqrt(np.sum(cells**2, axis=1, keepdims=True) + 1e-8)
            impulse = inertia * (step.twist - step.old) + [*friction.sum(axis=0), cross(step.arms, friction).sum()]
            assert impulse[:2] == pytest.approx(DT * step.force, abs=1e-8 * np.abs(impulse).max())
            # About the origin of the table.
            impulse[2] += cross(step.centre, impulse[:2])
            cone, does = wrenches_of_contacts(case, motion.pose[n], n, step.twist, step.contacts)
            unit = np.array([1.0, 1.0, 30.0])
            _, rest = nnls((np.array(cone) * unit).T, impulse * unit)
            assert rest <= 1e-6 * np.linalg.norm(impulse * unit), (seed, n, does)
            count[does] += 1
    print(dict(count))
    for does in ("sticks", "slides", "sticks and sticks", "slides and slides", *(["slides and sticks"] if on_corner else [])):
        assert count[does] >= 5, count


def held(shape: dict[str, Float64Array], *, spin: float, about: float, seconds: float = 2.0, start: float = 1e-6) -> PusherPath:
    """A tool before the left face of `block`, that turns about a point `about` [m] to its left, or goes straight ahead at 2 cm/s."""
    time = np.linspace(0.0, seconds, 201)
    yaw = spin * time
    first = np.array([-0.03 - RADIUS - start, 0.0])
    if spin == 0.0:
        return PusherPath(time, first + 0.02 * time[:, None] * [1.0, 0.0], RADIUS, yaw=yaw, **shape)
    centre = first + np.array([0.0, about])
    return PusherPath(time, centre + about * np.column_stack([np.sin(yaw), -np.cos(yaw)]), RADIUS, yaw=yaw, **shape)


def in_tool(path: PusherPath, pose: Float64Array, at: int) -> Float64Array:
    """Pose of the object in the frame of the tool at a sample of its path."""
    assert path.yaw is not None
    return np.array([*transform_points(inverse(np.array([*path.position[at], path.yaw[at]])), pose[None, :2])[0], pose[2] - path.yaw[at]])


@pytest.mark.parametrize("tool", TOOLS)
def test_straight_push_turns_the_object_only_if_its_centre_of_friction_is_not_between_the_contacts(tool: str) -> None:
    """Mason 1986: friction of a translating object acts at its centre, whatever else its distribution is."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        model = block()
        model = replace(
            model, friction=rng.uniform(0.0, 0.6, len(model.friction)) * (1.0 + 25.0 * model.shape.cells.centres[:, 1]).clip(0.0)
        )
        beyond = np.array([0.0, model.centre_of_friction[1] + 0.013])
        path = held(TOOLS[tool], spin=0.0, about=0.0)
        for offset, turns in ((np.array([0.0, model.centre_of_friction[1] - 0.011]), False), (beyond, True)):
            shifted = replace(path, position=path.position + offset)
            motion = simulate(model, PushScenario(shifted, np.zeros(3), path.time))
            assert bool(abs(motion.pose[-1, 2]) > 1e-2) is turns, (seed, offset)
            assert turns or np.abs(motion.pose[-1] - [0.04, 0.0, 0.0]).max() < 2e-6


@pytest.mark.parametrize("tool", TOOLS)
def test_tool_that_turns_about_a_distant_point_carries_the_object_rigidly_and_about_a_near_one_does_not(tool: str) -> None:
    for about, rigid in ((0.3, True), (-0.3, True), (0.012, False)):
        path = held(TOOLS[tool], spin=0.02 / about, about=about)
        motion = simulate(block(), PushScenario(path, np.zeros(3), path.time), settings=SimulationSettings(quasi_static=True))
        moved_in_tool = in_tool(path, motion.pose[-1], -1) - in_tool(path, motion.pose[0], 0)
        assert bool(np.abs(moved_in_tool).max() < 1e-5) is rigid, about


@pytest.mark.parametrize("tool", TOOLS)
def test_tool_that_slips_along_a_face_carries_the_object_at_mu_times_its_normal_speed(tool: str) -> None:
    """Both contacts slide: the force stands at the edge of the friction cone, and an object that does not turn moves along it."""
    mu, model = 0.2, block(pusher_friction=0.2)
    time = np.linspace(0.0, 0.2, 41)
    # The line of force through the centre of friction crosses the face at the middle between the contacts.
    first = np.array([-0.03 - RADIUS - 1e-9, -0.03 * mu - 0.05 * 0.2 * (0.5 - 0.1)])
    path = PusherPath(time, first + time[:, None] * [0.05, 0.05 * 0.5], RADIUS, yaw=np.zeros(41), **TOOLS[tool])
    motion = simulate(model, PushScenario(path, np.zeros(3), time), settings=SimulationSettings(quasi_static=True))
    assert motion.pose[-1] == pytest.approx([0.01, mu * 0.01, 0.0], abs=1e-7)
    assert motion.force[-1, 1] == pytest.approx(mu * motion.force[-1, 0], rel=1e-9)


def test_frictionless_fingers_beside_a_corner_hold_it_like_a_wedge() -> None:
    model, apart = block(pusher_friction=0.0), 0.02
    ends = apart * np.array([[0.0, 0.5], [0.0, -0.5]])
    diagonal = np.array([1.0, 1.0]) / np.sqrt(2.0)
    corner = np.array([-0.03, -0.025])
    # Both touch: the tool's origin lies on the diagonal through the corner of the fingers' inner tangents.
    origin = corner - (RADIUS + 1e-9) + (0.5 * apart / np.sqrt(2.0)) * np.array([1.0, 1.0])
    time = np.linspace(0.0, 0.5, 51)
    path = PusherPath(time, origin + 0.02 * time[:, None] * diagonal, RADIUS, yaw=np.full(51, np.pi / 4), fingers=ends)
    motion = simulate(model, PushScenario(path, np.zeros(3), time), settings=SimulationSettings(quasi_static=True))
    # Two frictionless normals meet in a point; where the centre of friction is off the diagonal through it, the object turns about it.
    relative = in_tool(path, motion.pose[-1], -1) - in_tool(path, motion.pose[0], 0)
    tips = transform_points(np.array([*path.position[-1], np.pi / 4]), ends)
    gaps = signed_distance(transform_points(inverse(motion.pose[-1]), tips), model.shape.outline) - RADIUS
    assert np.abs(gaps).max() < 1e-6 and np.abs(relative[2]) > 1e-3


@pytest.mark.parametrize("mode", ENGINES)
def test_motion_by_two_fingers_is_the_same_in_another_table_frame_and_in_a_mirror(mode: str) -> None:
    for seed in range(8):
        case = line_tool_case(seed, "fingers", 24, on_corner=seed % 2 == 1)
        motion = case.simulate(ENGINES[mode])
        # The pyramid stands in the axes of the table.
        angle = np.pi / 2 if mode == "pyramid" else 0.7
        by = np.array([0.1, -0.2, angle])
        turned = moved(case, by=by).simulate(ENGINES[mode])
        back = transform_points(inverse(by), turned.pose[:, :2])
        assert np.abs(np.column_stack([back, turned.pose[:, 2] - angle]) - motion.pose).max() < 1e-8
        assert np.abs(mirrored(case).simulate(ENGINES[mode]).pose * [1.0, -1.0, -1.0] - motion.pose).max() < 1e-8


def test_many_models_at_once_move_as_each_alone() -> None:
    case = line_tool_case(4, "fingers", 24, on_corner=True)
    shape, times = case.model.shape, case.pusher.time[[0, -1]]
    models = [BatchModel(case.body, mu) for mu in (0.1, 0.5)]
    together = rollouts(shape, models, [BatchPush(case.pusher, case.pose, times)], step=DT)
    for model, poses in zip(models, together, strict=True):
        alone = simulate(
            replace(case.model, pusher_friction=model.pusher_friction),
            PushScenario(case.pusher, case.pose, times),
            settings=SimulationSettings(step=DT, resolve_events=True),
        )
        assert poses[0] == pytest.approx(alone.pose, abs=1e-12)
    assert np.abs(together[0] - together[1]).max() > 1e-4
    one, other = BatchPush(case.pusher, case.pose, times), BatchPush(replace(case.pusher, fingers=2.0 * LINE), case.pose, times)
    with pytest.raises(InputError, match="differ in their pusher"):
        rollouts(shape, models, [one, other], step=DT)


def test_oblique_push_slides_along_the_face_with_little_friction_only() -> None:
    turned = []
    for mu in (0.05, 2.0):
        path = held(TOOLS["fingers"], spin=0.0, about=0.0)
        path = replace(path, position=path.position + np.column_stack([np.zeros(201), np.linspace(0.0, 0.01, 201)]))
        motion = simulate(block(mu), PushScenario(path, np.zeros(3), path.time), settings=SimulationSettings(quasi_static=True))
        turned.append(float(in_tool(path, motion.pose[-1], -1)[1]))
    assert abs(turned[1]) < 1e-5 and turned[0] < -0.005


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fingers": LINE, "polygon": LINE}, "both fingers and a polygon"),
        ({"fingers": 0.1 * LINE}, "more than their diameter"),
        ({"fingers": np.zeros((3, 2))}, "expected"),
        ({"polygon": np.zeros((2, 2))}, "two ends of a plate"),
    ],
)
def test_tools_that_make_no_sense_are_refused(changes: dict[str, Float64Array], words: str) -> None:
    with pytest.raises(InputError, match=words):
        PusherPath(np.array([0.0, 1.0]), np.zeros((2, 2)), RADIUS, **changes)


def test_size_of_a_tool_is_that_of_the_circle_around_it() -> None:
    fingers = PusherShape(RADIUS, fingers=LINE)
    assert fingers.reach == pytest.approx(0.015) and not fingers.is_cylinder
    assert PusherShape(RADIUS).reach == RADIUS and PusherShape(RADIUS).is_cylinder
    assert np.array_equal(PusherShape(RADIUS, LINE).core, LINE)
