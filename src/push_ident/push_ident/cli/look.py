"""`push-ident look`: what a depth camera sees of a table, without a number given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer

from push_ident.bags.contract import Role, topic_of
from push_ident.bags.opening import SUFFIXES
from push_ident.bags.read_options import ReadOptions
from push_ident.bags.reader import read_depth
from push_ident.cli.checks import above_zero, writable_folder
from push_ident.cli.identify import CameraOption, DepthUnitOption, MapOption, read_camera, read_options
from push_ident.cli.output import JsonOption, console, millimetres, number_table, say, warn, write_json
from push_ident.cli.units import parse_floats, read_number
from push_ident.errors import InputError, PerceptionError
from push_ident.extras import need, need_ros
from push_ident.files import write_whole
from push_ident.offline.depth_images import DepthImages
from push_ident.survey.parameter_file import parameter_text
from push_ident.survey.scale_check import KnownSize, ScaleCheck, check_scale
from push_ident.survey.survey import Survey, frames_at_rest, survey_frames
from push_ident.survey.survey_page import survey_json, table_sentence, write_survey_page
from push_ident.survey.survey_picture import is_small, size_text
from push_ident.types import DepthFrame, Float64Array

_FILES: Final = ("look.html", "perception.yaml")
_TOPIC: Final = topic_of(Role.DEPTH)
"""Of the camera that is listened to where no other is given: that of perception_node."""


_OutFolder = Annotated[Path, typer.Option("--out", metavar="DIR", callback=writable_folder, help="Folder for page and parameter file.")]
_SourceArgument = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="A bag with depth images, a folder of depth images (16-bit PNG, 32-bit TIFF, .npy, organised PCD), or one of them; "
        f"with --live the topic of the images, {_TOPIC} by default.",
        show_default=False,
    ),
]
_IntrinsicsOption = Annotated[
    str,
    typer.Option(
        metavar="FX,FY,CX,CY",
        help="Of the images of a folder, in pixels. Default: its camera_info.yaml, or the points of a PCD.",
        show_default=False,
    ),
]
_KnownOption = Annotated[
    str,
    typer.Option(
        metavar="WxDxH",
        help="Size [m] of a box, or of the legs of a right-angled mark, on the table: checks focal length and depth scale. "
        "The height may be left out.",
        show_default=False,
    ),
]


def look_command(
    source: _SourceArgument = "",
    live: Annotated[bool, typer.Option("--live", help="Listen to the depth camera that runs now.")] = False,
    seconds: Annotated[
        float, typer.Option(min=0.5, callback=above_zero, help="Longest time to wait for a rest of a live camera [s].")
    ] = 15.0,
    out: _OutFolder = Path("out/look"),
    json: JsonOption = None,
    camera: CameraOption = None,
    intrinsics: _IntrinsicsOption = "",
    depth_unit: DepthUnitOption = None,
    map_: MapOption = None,
    known: _KnownOption = "",
) -> None:
    """Find table, noise and objects in depth images, without any setting, and say what is refused and why."""
    need("report")
    size, given = _known(known), read_camera(camera)
    options = read_options(map_, depth_unit)
    name = source or _TOPIC if live else Path(source).name
    with console.status("reading") as status:
        if live:
            _check_live(source, intrinsics, options)
        seen = _listen(name, seconds, status.update) if live else _read(source, _intrinsics(intrinsics), options)
        survey = survey_frames(seen.frames, seen.camera_in_table if given is None else given, seen.notes)
        check, unchecked = _checked(survey, size)
    parameters = parameter_text(survey, name)
    write_whole(out / "perception.yaml", parameters, "the parameters")
    write_survey_page(out / "look.html", survey, name, parameters, check or (str(unchecked) if unchecked else None))
    write_json(json, survey_json(survey, check))
    _show(survey, check)
    say(f"written: {', '.join(str(out / name) for name in _FILES)}")
    if unchecked is not None:
        raise unchecked
    if survey.failure:
        raise PerceptionError(survey.failure)


@dataclass(frozen=True, slots=True)
class _Seen:
    frames: list[DepthFrame]
    """Those at rest."""
    camera_in_table: Float64Array | None
    """Pose of the optical frame, shape (4, 4); None where the source has none."""
    notes: list[str]


def _read(text: str, intrinsics: tuple[float, float, float, float] | None, options: ReadOptions) -> _Seen:
    if not text:
        raise InputError("There is no SOURCE; give a bag, a folder of depth images, or --live for a camera that runs.")
    source = Path(text)
    if not _is_bag(source):
        if options.topics:
            raise InputError(f"{source} is no bag, and has no topics; leave out --map.")
        images = DepthImages(source, intrinsics, options.depth_unit)
        frames, passed = frames_at_rest(images.frames())
        return _Seen(frames, None, [*images.skipped, passed])
    if intrinsics is not None:
        raise InputError(f"{source} is a bag, which has the intrinsics of its images; leave out --intrinsics.")
    recording = read_depth(source, options)
    frames, passed = frames_at_rest(recording.frames())
    return _Seen(frames, recording.camera_in_table, [*recording.notes, passed])


def _check_live(source: str, intrinsics: str, options: ReadOptions) -> None:
    """Raises InputError for what a live camera does not have."""
    if intrinsics or options != ReadOptions():
        raise InputError(
            "--live has intrinsics from camera_info, the unit from the encoding, and its topic as SOURCE; leave out --intrinsics, "
            "--depth-unit and --map."
        )
    if source and Path(source).exists():
        raise InputError(f"{source} is a file or folder, expected a topic such as {_TOPIC}; leave out --live to look at it.")


def _listen(topic: str, seconds: float, show: Callable[[str], None]) -> _Seen:
    """What a camera that runs now has. Raises InputError or FrameError."""
    need_ros()
    from push_ident.nodes.client.depth_capture import DepthCapture  # without --live no ROS is needed

    with DepthCapture(topic, seconds=seconds, on_progress=show) as camera:
        say(f"listening to {camera.topic} and {camera.info_topic} for up to {seconds:g} s")
        frames, passed = frames_at_rest(camera.frames())
        say(f"{len(frames)} depth images at rest")
        return _Seen(frames, camera.camera_in_table, [*camera.notes, passed])


def _is_bag(source: Path) -> bool:
    if source.is_dir():
        return (source / "metadata.yaml").exists() or any(path.suffix in SUFFIXES for path in source.iterdir())
    return source.suffix in SUFFIXES


def _intrinsics(text: str) -> tuple[float, float, float, float] | None:
    if not text:
        return None
    fx, fy, cx, cy = parse_floats(
        text, ["px"] * 4, "--intrinsics", "four numbers fx,fy,cx,cy in pixels, such as 600,600,319.5,239.5"
    ).tolist()
    return fx, fy, cx, cy


def _known(text: str) -> KnownSize | None:
    if not text:
        return None
    try:
        width, depth, *height = (read_number(word, "m") for word in text.lower().split("x"))
        (first,) = height or (None,)
    except ValueError:
        raise InputError(
            f"--known is `{text}`, expected width x depth x height, such as 0.2x0.1x0.05 in metres or 200mmx100mmx50mm."
        ) from None
    return KnownSize(width, depth, first)


def _checked(survey: Survey, size: KnownSize | None) -> tuple[ScaleCheck | None, PerceptionError | None]:
    """The check of the scale where a size was given, or why there is none."""
    if size is None:
        return None, None
    try:
        return check_scale(survey, size), None
    except PerceptionError as error:
        return None, error


def _show(survey: Survey, check: ScaleCheck | None) -> None:
    for note in survey.notes:
        warn(f"note: {note}")
    say(table_sentence(survey))
    table = number_table("noise of a height on the table", "distance", "points", "deviation", "systematic")
    for band in survey.bands:
        table.add_row(
            f"{band.near:g} to {band.far:g} m", str(band.n_points), f"{1e3 * band.deviation:.2f} mm", f"{1e3 * band.median:+.2f} mm"
        )
    console.print(table)
    for own in survey.objects:
        say(f"{own.object_id}: {size_text(own)}, {own.distance:.2f} m away")
    if not survey.objects and not survey.failure:
        say(f"no object: {survey.why_no_object}")
    listed = [refusal for refusal in survey.refused if not is_small(refusal)]
    for number, refusal in enumerate(listed, start=1):
        say(f"{number}, {millimetres(refusal.height)} high, is no object: {refusal.why}")
    if n_small := len(survey.refused) - len(listed):
        say(f"{n_small} {'patch' if n_small == 1 else 'patches'} smaller than min_object_area, or no higher than the noise there")
    if check is not None:
        say(check.sentence)
