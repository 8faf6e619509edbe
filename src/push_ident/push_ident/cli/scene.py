"""Options that name a user's own simulation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from push_ident.cli.units import parse_floats
from push_ident.errors import InputError

if TYPE_CHECKING:
    from push_ident.simulators.bullet_scene import BulletScene
    from push_ident.simulators.mujoco_scene import MujocoScene

ObjectBodyOption = Annotated[
    str, typer.Option("--object-body", metavar="NAME", help="Body of the object in the scene.", show_default=False)
]
PusherBodyOption = Annotated[
    str, typer.Option("--pusher-body", metavar="NAME", help="Body of the pusher in the scene, a child of the world.", show_default=False)
]
TableInSceneOption = Annotated[
    str, typer.Option(metavar="X,Y,YAW", help="Frame `table` of the pushes in the scene [m, m, rad].", show_default="0,0,0")
]
ObjectInBodyOption = Annotated[
    str, typer.Option(metavar="X,Y,YAW", help="Frame of the object's poses in its body [m, m, rad].", show_default="0,0,0")
]


EngineFrictionOption = Annotated[
    str,
    typer.Option(
        "--engine-friction",
        metavar="TABLE,PUSHER",
        help="Of a URDF or SDF: lateral friction of plane and pusher in your program.",
        show_default="1,1",
    ),
]


def scene_of(
    path: Path, object_body: str, pusher_body: str, table_in_scene: str, object_in_body: str, engine_friction: str = ""
) -> MujocoScene | BulletScene:
    """The scene of the options, by the suffix of the file. Raises InputError where it cannot be read, or a body is missing or not named."""
    table, frame = (
        parse_floats(text or "0,0,0", ("m", "m", "rad"), option, "X,Y,YAW in metres and radians, such as 0.4,-0.1,1.57")
        for text, option in ((table_in_scene, "--table-in-scene"), (object_in_body, "--object-in-body"))
    )
    if path.suffix.lower() in (".urdf", ".sdf"):
        from push_ident.simulators.bullet_scene import BulletScene

        of_table, of_pusher = parse_floats(engine_friction or "1,1", ("", ""), "--engine-friction", "TABLE,PUSHER, such as 0.5,1.0")
        return BulletScene(path, float(of_table), float(of_pusher), table, frame)
    from push_ident.simulators.mujoco_scene import MujocoScene

    if not object_body or not pusher_body:
        raise InputError("Name the bodies of the scene with --object-body and --pusher-body.")
    return MujocoScene(path, object_body, pusher_body, table, frame)
