"""`push-ident up`, `replay` and `doctor`: commands that start or inspect live nodes."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.table import Table

from push_ident.bags.pushes import count_pushes, split_pushes
from push_ident.bags.reader import read_bag
from push_ident.cli.checks import above_zero, at_least_zero, new_bag
from push_ident.cli.identify import DepthUnitOption, MapOption, read_options
from push_ident.cli.live_view import ViewOption, show_view
from push_ident.cli.output import JsonOption, OutOption, console, say, status, warn, write_json
from push_ident.cli.overrides import overrides_of
from push_ident.cli.processes import RestartPolicy
from push_ident.cli.robot import RobotOption, robot_for
from push_ident.cli.supervisor import Kind, Supervisor, node_commands, node_names
from push_ident.cli.units import in_unit
from push_ident.errors import InputError, PushIdentError
from push_ident.extras import need_ros
from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.nodes.base.network import listens_on, own_domain
from push_ident.offline.loading import most_pushed
from push_ident.physics.simulation import compile_kernels

if TYPE_CHECKING:
    from push_ident.nodes.client.cell_client import CellClient
    from push_ident_msgs.msg import MassFrictionMap


def up_command(
    kind: Annotated[
        Kind,
        typer.Argument(metavar="sim|replay|arm", help="sim: simulated cell; replay: a bag; arm: beside a real arm.", show_default=False),
    ],
    bag: Annotated[Path | None, typer.Argument(metavar="[BAG]", help="Bag to play, for replay.", show_default=False)] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="BAG", callback=new_bag, help="Record the cell to this new bag.", show_default=False)
    ] = None,
    view: ViewOption = False,
    sensor: Annotated[str | None, typer.Option(metavar="NAME", help="Model of the simulated depth camera.", show_default="plain")] = None,
    state: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder that keeps objects and maps for the next start. Default: none.", show_default=False),
    ] = None,
    robot: RobotOption = None,
    params: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="Parameter file of ROS 2 for the nodes; may be repeated.", show_default=False)
    ] = None,
    remap: Annotated[
        list[str] | None,
        typer.Option(metavar="FROM:=TO", help="Another name of a topic; may be repeated.", show_default=False),
    ] = None,
) -> None:
    """Start the node processes of a cell, as the launch files do; Ctrl-C stops them all.

    A node that dies is started again after a pause of 1 s, doubled up to 30 s while it dies early; the maps go on where they were.
    """
    need_ros()
    names = node_names(kind)
    chosen = None if robot is None else robot_for(kind, robot)
    # Of two rules for one name ROS takes the first: those of the command line come before those of the robot.
    overrides = overrides_of(params or (), [*(remap or ()), *(chosen.remaps if chosen else ())], names)
    perception = kind != "replay" or bag is None or not read_bag(bag).has_poses
    extra = [name for name, wanted in (("bag_recorder_node", record is not None), ("viewer_node", view)) if wanted]
    with TemporaryDirectory(prefix="push_ident_") as until_the_end:
        folder: dict[str, object] = {"state_directory": str((state or Path(until_the_end)).resolve())}
        own = {} if chosen is None else chosen.parameters(Path(until_the_end), extra)
        for name in ("perception_node", "identification_node") if perception else ("identification_node",):
            own.setdefault(name, {}).update(folder)
        if sensor is not None:
            if kind != "sim":
                raise InputError(f"--sensor is a model of the simulated camera, and `up {kind}` has none.")
            own.setdefault("sim_cell_node", {})["sensor"] = sensor
        if record is not None:
            # Started again after its death, it must not refuse what it has written.
            own.setdefault("bag_recorder_node", {})["numbered"] = True
        commands = node_commands(kind, bag=bag, record=record, perception=perception, view=view, parameters=own, overrides=overrides)
        show_view(view)
        # A bag that is played again from its start would be another recording.
        restart = None if kind == "replay" else RestartPolicy()
        raise typer.Exit(Supervisor(commands, console=console, restart=restart).run())


def replay_command(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help="Bag to play.", show_default=False)],
    rate: Annotated[
        float,
        typer.Option(min=0.0, callback=at_least_zero, help="Speed relative to real time, where the nodes keep up; 0: as fast as they can."),
    ] = 1.0,
    view: ViewOption = False,
    out: OutOption = None,
    json: JsonOption = None,
    map_: MapOption = None,
    depth_unit: DepthUnitOption = None,
) -> None:
    """Play a bag through the live nodes and show the identified maps. It ends when every push is learned or refused, at any speed and load.

    The exit status is 0 only where as many pushes were learned as the bag has.
    """
    need_ros()
    contents = read_bag(bag, read_options(map_, depth_unit))  # an unusable bag is refused before any process starts
    if contents.has_poses:
        split_pushes(contents, most_pushed(contents))
    # Poses have two subscribers, the identification node and this command; depth has one, perception.
    player: dict[str, object] = {"rate": rate, "listeners": 2 if contents.has_poses else 1, "wait": 30.0}
    parameters = {"bag_player_node": player | {"maps": map_ or [""], "depth_unit": depth_unit or 0.0}}
    if not contents.has_poses and contents.camera_in_table is not None:
        camera = contents.camera_in_table
        pose: dict[str, object] = {
            "camera_position": [float(x) for x in camera[:3, 3]],
            "camera_quaternion": list(quaternion_of_pose(camera)),
        }
        parameters["perception_node"] = pose
    commands = node_commands("replay", bag=bag, perception=not contents.has_poses, view=view, parameters=parameters)
    os.environ.setdefault("ROS_DOMAIN_ID", str(own_domain()))
    with status("loading the kernels, the first time for minutes"):
        compile_kernels(effects=True)  # in which the node would seem to stand still
    with Supervisor(commands, log_dir=out / "log" if out else None) as supervisor:
        show_view(view)
        from push_ident.nodes.client.cell_client import CellClient

        with CellClient(check=supervisor.check) as client, status(f"playing {bag}") as show:
            _await_played(client, supervisor, sum(contents.topics.values()), show)
            show("waiting for the last push to be identified")
            client.wait_until_settled(quiet=1.0, patience=_PATIENCE)
            counts = client.values_of("identification")
            learned = [client.latest_map(object_id) for object_id in client.object_ids()]
            latest = max((m for m in learned if m is not None), key=lambda m: m.n_pushes, default=None)
            if latest is None:
                raise PushIdentError(f"nothing was learned from {bag}: {client.reasons() or 'no node reported anything'}")
            if out is not None:
                client.save_model(latest.object_id, str((out / "model.json").resolve()))
            health = next((s.message for s in client.diagnostics.values() if "identification" in s.name and s.level != s.OK), "")
    _show_replay(latest, counts, out, json)
    if latest.status in (latest.STATUS_FAILED, latest.STATUS_PRIOR):
        warn(f"push-ident: {health or latest.status_text}; the maps that are written are the prior")
        raise typer.Exit(1)
    played, n_learned = count_pushes(contents), int(counts.get("pushes", 0))
    if n_learned < played:
        warn(f"push-ident: {n_learned} of {played} pushes of the bag were learned; {_left_out(counts)}")
        raise typer.Exit(1)


def _await_played(client: CellClient, supervisor: Supervisor, n_messages: int, show: Callable[[str], None]) -> None:
    """Wait until the player of a bag of so many messages has ended; `show` gets each tenth of them."""

    def is_played() -> bool:
        if tenths := 10 * int(client.values_of("bag_player").get("messages played", 0)) // max(n_messages, 1):
            show(f"played {10 * min(tenths, 10)} %")
        return supervisor.exit_code("bag_player_node") is not None

    client.wait(is_played, _PATIENCE, _STUCK, client.heard_from("bag_player"))


_PATIENCE: Final = 300.0
"""Longest time in which a node of a replay reports nothing new [s]; on a loaded machine one solve may take a minute."""
_STUCK: Final = f"the bag went on no further for {_PATIENCE:.0f} s; see the log of bag_player_node"


def _left_out(counts: dict[str, str]) -> str:
    kinds = ("pushes refused", "pushes without contact", "pushes known already", "pushes that failed, left out")
    found = [f"{counts[kind]} {kind.removeprefix('pushes ')}" for kind in kinds if counts.get(kind, "0") != "0"]
    reason = counts.get("last error", "none")
    return (", ".join(found) or "the others did not arrive") + (f" (the last reason: {reason})" if reason != "none" else "")


def _show_replay(latest: MassFrictionMap, counts: dict[str, str], out: Path | None, json: Path | None) -> None:
    mass, friction = list(latest.mass), list(latest.friction)
    say(
        f"object {latest.object_id}: {len(mass)} cells, {latest.n_pushes} pushes, {latest.status_text}; pusher friction "
        f"{latest.pusher_friction:.2f} ± {latest.pusher_friction_std:.2f}"
    )
    content = {
        "object_id": latest.object_id,
        "n_pushes": int(latest.n_pushes),
        "status": latest.status_text,
        "map": {
            "x": list(latest.x),
            "y": list(latest.y),
            "mass": mass,
            "friction": friction,
            "mass_friction": list(latest.mass_friction),
            "mass_friction_std": list(latest.mass_friction_std),
        },
        "pusher_friction": {"value": latest.pusher_friction, "std": latest.pusher_friction_std},
        "counts": counts,
    }
    write_json(json, content)
    if out is not None:
        write_json(out / "result.json", content)
        say(f"written: {out / 'model.json'}, {out / 'result.json'}")


_PACKAGES = ("numpy", "scipy", "numba", "torch", "opencv-python-headless", "open3d", "pybullet", "pin", "rosbags", "mcap", "matplotlib")
_EXTRA_OF: Final = {"torch": "torch", "open3d": "pcd", "pin": "arm", "matplotlib": "report"}
"""Packages that only some features need, and the extra of the wheel that brings each."""


def doctor_command(
    seconds: Annotated[float, typer.Option(min=0.5, callback=above_zero, help="How long to listen.")] = 4.0,
    robot: RobotOption = None,
    spacing: Annotated[
        float, typer.Option(parser=in_unit("m", 0.01, 1.0), help="Distance of the places at which pushes are planned, with --robot [m].")
    ] = 0.05,
    out: OutOption = None,
    json: JsonOption = None,
) -> None:
    """Report installed packages, the ROS in use, live topics, and what is missing; or check a robot file.

    With --robot only that file is checked: joints, limits, frames, reach of the workspace, and the cell that runs, if one does. --out then
    gets the page of the reach. The exit status is 1 where something is wrong.
    """
    if robot is not None:
        from push_ident.cli.robot_doctor import examine_robot

        raise typer.Exit(examine_robot(robot, spacing=spacing, seconds=seconds, out=out, json=json))
    if out is not None:
        raise InputError("--out gets the page of the reach of a robot; give --robot FILE, or take it out.")
    problems: list[str] = []
    installed: dict[str, str | None] = {}
    for name in _PACKAGES:
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            installed[name] = None
            if name not in _EXTRA_OF:
                problems.append(f"the package {name} is not installed; run `make setup` in a clone of the repository")
    table = Table(title="installed", show_header=False)
    table.add_row("python", f"{sys.version.split()[0]}, {sys.executable}")
    for name, version in installed.items():
        absent = f"not installed: pip install 'push_ident\\[{_EXTRA_OF[name]}]'" if name in _EXTRA_OF else "missing"
        table.add_row(name, version or absent)
    console.print(table)
    ros = _ros(problems)
    console.print(*(f"{key}: {value}" for key, value in ros.items()), sep="\n", highlight=False, soft_wrap=True)
    free = shutil.disk_usage(".").free
    if free < 1 << 30:
        problems.append(f"only {free >> 20} MiB of disk are free here; a depth recording takes some 18 MB/s")
    topics = _topics(seconds, problems) if ros["rclpy"] != "missing" else []
    if topics:
        alive = Table("topic", "type", "rate [Hz]", "QoS", title=f"topics of the bag contract, over {seconds:.0f} s")
        for row in topics:
            alive.add_row(row["topic"], row["type"], f"{row['rate_hz']:.1f}", row["qos"])
        console.print(alive)
    for problem in problems:
        warn(f"! {problem}")
    if not problems:
        console.print("nothing is missing")
    write_json(json, {"installed": installed, "ros": ros, "topics": topics, "problems": problems})


def _ros(problems: list[str]) -> dict[str, str]:
    found = {"ROS_DISTRO": os.environ.get("ROS_DISTRO", "not set")}
    try:
        import rclpy

        found["rclpy"] = str(Path(rclpy.__file__).parent)
    except ImportError as error:
        problems.append(
            f"rclpy cannot be imported ({error}); run `make setup` in a clone of the repository, or source /opt/ros/jazzy/setup.bash"
        )
        found["rclpy"] = "missing"
        return found
    from rclpy.utilities import get_rmw_implementation_identifier

    found["middleware"] = get_rmw_implementation_identifier()
    found["ROS_DOMAIN_ID"] = os.environ.get("ROS_DOMAIN_ID", "0 (not set)")
    found["listens on"] = listens_on(os.environ)
    try:
        import push_ident_msgs.msg

        found["push_ident_msgs"] = str(Path(push_ident_msgs.msg.__file__).parent)
    except ImportError as error:
        problems.append(f"push_ident_msgs cannot be imported ({error}); run `make setup`, or `colcon build` and source install/setup.bash")
        found["push_ident_msgs"] = "missing"
    return found


def _topics(seconds: float, problems: list[str]) -> list[dict[str, Any]]:
    from push_ident.nodes.client.listen import listen_to_contract

    rows = listen_to_contract(seconds)
    if not rows:
        problems.append(
            "no topic of the bag contract is published: start a cell with `push-ident up sim`, or check ROS_DOMAIN_ID "
            "and ROS_AUTOMATIC_DISCOVERY_RANGE if one is running"
        )
    for row in rows:
        if row["silent"]:
            problems.append(f"{row['topic']} has a publisher but nothing came within {seconds:.0f} s; see its node's log")
    return rows
