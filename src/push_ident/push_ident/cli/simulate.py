"""`push-ident simulate`: a bag of simulated pushes, with injected effects on request."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from push_ident.cli.checks import at_least_zero, new_bag, writable_file
from push_ident.cli.experiment import sim_module
from push_ident.cli.output import console, say, write_json
from push_ident.cli.units import in_unit, parse_floats
from push_ident.errors import InputError

_YAW_NOISE = round(math.radians(0.5), 5)
_PositionNoiseOption = Annotated[
    float, typer.Option(parser=in_unit("m"), callback=at_least_zero, help="Standard deviation of x and y [m].")
]
_YawNoiseOption = Annotated[float, typer.Option(parser=in_unit("rad"), callback=at_least_zero, help="Standard deviation of the yaw [rad].")]


def simulate_command(
    out: Annotated[Path | None, typer.Option(metavar="BAG", callback=new_bag, help="New bag.", show_default=False)] = None,
    object_name: Annotated[str, typer.Option("--object", help="hammer, wrench, crimp, toolbox or book.")] = "hammer",
    effect: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE[,VALUE]", help="Effect to inject; may be given again. See --effects.", show_default=False),
    ] = None,
    pushes: Annotated[int, typer.Option(min=1, help="Number of pushes.")] = 14,
    model: Annotated[int, typer.Option(min=0, help="Ground truth of the object's masses and frictions.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the pushes and of all noise.")] = 0,
    speed: Annotated[str, typer.Option(metavar="LOW,HIGH", help="Range of the speed of the pushes [m/s].")] = "0.1,0.2",
    position_noise: _PositionNoiseOption = 0.001,
    yaw_noise: _YawNoiseOption = _YAW_NOISE,
    force_noise: Annotated[
        float, typer.Option(callback=at_least_zero, help="Standard deviation of each component of the force [N].")
    ] = 0.05,
    camera: Annotated[bool, typer.Option("--camera", help="Write depth images instead of poses, 15 per second.")] = False,
    sensor: Annotated[
        str, typer.Option(metavar="NAME", help="Model of that camera: plain, ideal, kinect_v1, realsense_d435_848x480, phoxi, ...")
    ] = "plain",
    truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", callback=writable_file, help="Write masses, frictions and effects here (JSON).", show_default=False),
    ] = None,
    effects: Annotated[bool, typer.Option("--effects", help="List the effects and exit.")] = False,
) -> None:
    """Push an object in the simulated cell and write the observations as a bag."""
    injected = sim_module("push_ident_sim.injected")
    if effects:
        for entry in injected.INJECTED.values():
            lines = [f"{entry.name}: {entry.what}", *(f"    {p.described}" for p in entry.parameters), f"    Simulated: {entry.how}."]
            say("\n".join(lines))
        return
    if out is None:
        raise InputError("--out is missing; name the new bag, such as --out out/tilted.")
    recording, pushing = sim_module("push_ident_sim.recordings.recording"), sim_module("push_ident_sim.recordings.truth")
    low, high = parse_floats(speed, ("m/s", "m/s"), "--speed", "LOW,HIGH in m/s such as 0.1,0.2").tolist()
    settings = recording.RecordingSettings(
        object_name=object_name,
        model=model,
        n_pushes=pushes,
        seed=seed,
        effects=injected.InjectedEffects.parse(effect or ()),
        speed_range=(low, high),
        noise=pushing.CameraNoise(
            position_std=position_noise,
            yaw_std=yaw_noise,
            force_std=force_noise,
            **({"rate": 15.0, "rest": 1.0} if camera else {}),
        ),
        camera=camera,
        sensor=sensor,
    )
    # In a separate process, which discards the output of the engine.
    with console.status("pushing"), sim_module("push_ident_sim.workers").single_threads() as pool:
        content = pool.submit(recording.record_pushes, out, settings).result()
    say(f"written: {out}; SHA-256 of its truth: {recording.seal(content)}")
    if truth is not None:
        write_json(truth, content)
        say(f"written: {truth}")
