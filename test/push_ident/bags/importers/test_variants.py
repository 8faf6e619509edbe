"""Forms in which other laboratories write the same recording: each gives the same pushes, or says what is wrong, and its remedy helps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from helpers.commands import run_here
from helpers.recordings import table_file
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.checking.records import check_records
from push_ident.geometry.se2 import rotation
from push_ident.types import Float64Array, PushRecord

EPOCH = 1.7e9
"""A time of this century by a computer's clock [s]."""
UPRIGHT = "time,x,y,z,qx,qy,qz,qw"
Rewrite = Callable[[Float64Array], Float64Array]


def same(rows: Float64Array) -> Float64Array:
    return rows


def untouched(file: Path) -> None:
    """As it was written."""


def times(*factors: float) -> Rewrite:
    return lambda rows: rows * factors


def later(seconds: float, factor: float = 1.0) -> Rewrite:
    return lambda rows: np.column_stack([(rows[:, 0] + seconds) * factor, rows[:, 1:]])


def quaternions(*, sign: float = 1.0, y_up: bool = False) -> Rewrite:
    """Poses in space, of every second frame with `sign` times the quaternion."""

    def rewrite(rows: Float64Array) -> Float64Array:
        time, x, y, yaw = rows.T
        zero, z = 0.0 * time, 0.0 * time + 0.03
        q = np.column_stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)])
        q[::2] *= sign
        place = np.column_stack([x, z, -y] if y_up else [x, y, z])
        return np.column_stack([time, place, q[:, [0, 2, 1, 3]] * [1, 1, -1, 1] if y_up else q])

    return rewrite


def in_frame(rows: Float64Array) -> Float64Array:
    """The pusher in a frame at (0.5, 0.2) m, turned by 0.5 rad."""
    return np.column_stack([rows[:, 0], (rows[:, 1:] - [0.5, 0.2]) @ rotation(0.5)])


def text(change: Callable[[str], str]) -> Callable[[Path], object]:
    return lambda file: file.write_bytes(change(file.read_text()).encode())


def lost_as(sign: str) -> Callable[[Path], object]:
    lines = slice(50, 60)

    def rewrite(file: Path) -> None:
        rows = file.read_text().splitlines()
        if file.stem == "poses":
            rows[lines] = [row.split(",")[0] + 3 * ("," + sign) for row in rows[lines]]
        file.write_text("\n".join(rows) + "\n")

    return rewrite


@dataclass(frozen=True)
class Variant:
    """What another laboratory does, which text answers it, and the options that the text names; no text: it is right at once."""

    poses: Rewrite = same
    names: str = "time,x,y,yaw"
    tool: Rewrite = same
    tool_names: str = "time,x,y"
    outline: Rewrite = same
    files: Callable[[Path], object] = untouched
    separator: str = ","
    given: Sequence[object] = ()
    says: str = ""
    remedy: Sequence[object] | None = None


VARIANTS = {
    "degrees by name": Variant(times(1, 1, 1, 180 / np.pi), "time,x,y,yaw_deg"),
    "degrees": Variant(times(1, 1, 1, 180 / np.pi), says="--angle-unit", remedy=("--angle-unit", "deg")),
    "millimetres by name": Variant(times(1, 1e3, 1e3, 1), "time,x_mm,y_mm,yaw"),
    "millimetres": Variant(
        times(1, 1e3, 1e3, 1),
        tool=times(1, 1e3, 1e3),
        outline=times(1e3, 1e3),
        says="millimetres, centimetres",
        remedy=("--length-unit", "mm"),
    ),
    "poses in inches": Variant(
        times(1, 1 / 0.0254, 1 / 0.0254, 1),
        says="poses are in inches",
        remedy=("--length-unit", "in", "--pusher-length-unit", "m", "--outline-length-unit", "m"),
    ),
    "outline in millimetres": Variant(outline=times(1e3, 1e3), says="outline.csv", remedy=("--outline-length-unit", "mm")),
    "nanoseconds since 1970": Variant(later(EPOCH, 1e9), "time_ns,x,y,yaw", later(EPOCH, 1e9), "time_ns,x,y"),
    "milliseconds": Variant(times(1e3, 1, 1, 1), tool=times(1e3, 1, 1), says="unit of time", remedy=("--time-unit", "ms")),
    "clocks that begin apart": Variant(later(EPOCH), says="--time-offset", remedy=("--time-offset", EPOCH)),
    "pusher 0.1 s late": Variant(tool=later(0.1), says="-0.10 to --time-offset", remedy=("--time-offset", -0.1)),
    "stamps in whole seconds": Variant(lambda rows: np.column_stack([np.floor(rows[:, 0]), rows[:, 1:]]), says="too few digits"),
    "each pose twice": Variant(lambda rows: np.repeat(rows, 2, axis=0)),
    "rows out of order": Variant(lambda rows: np.roll(rows, 7, axis=0), says="sort the rows"),
    "y up": Variant(quaternions(y_up=True), UPRIGHT, says="--axes x,-z,y", remedy=("--axes", "x,-z,y", "--pusher-axes", "x,y,z")),
    "quaternions of either sign": Variant(quaternions(sign=-1.0), UPRIGHT),
    "quaternions with w first": Variant(lambda rows: quaternions()(rows)[:, [0, 1, 2, 3, 7, 4, 5, 6]], "time,x,y,z,qw,qx,qy,qz"),
    "yaw that wraps": Variant(lambda rows: np.column_stack([rows[:, :3], np.angle(np.exp(1j * (rows[:, 3] + 1.0))) - 1.0])),
    "Excel": Variant(files=text(lambda content: "\ufeff" + content.replace("\n", "\r\n"))),
    "decimal commas": Variant(files=text(lambda content: content.replace(".", ",")), separator=";"),
    "lost frames empty": Variant(files=lost_as("")),
    "lost frames as NaN": Variant(files=lost_as("NaN")),
    "lost frames as a dash": Variant(files=lost_as("-"), says="expected a number"),
    "pusher in another frame": Variant(tool=in_frame, says="--pusher-frame 0.5", remedy=("--pusher-frame", "0.5,0.2,0.5")),
    "x and y exchanged": Variant(
        lambda rows: rows[:, [0, 2, 1, 3]], says="x and y of the poses are exchanged", remedy=("--columns", "x=y,y=x")
    ),
    "outline clockwise and closed": Variant(outline=lambda points: np.vstack([points[::-1], points[-1:]])),
    "outline from its corner": Variant(outline=lambda points: points - points.min(axis=0), says="origin of the outline"),
    "outline turned": Variant(outline=lambda points: points @ rotation(1.2).T, says="turn its points by -68.8 degrees"),
    "diameter for radius": Variant(given=("--radius", 0.016), says="radius of the pusher is 8.0 mm", remedy=("--radius", 0.008)),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_variant_is_read_or_its_remedy_helps(
    name: str, tmp_path: Path, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord]
) -> None:
    variant = VARIANTS[name]
    tables = {
        "poses": (variant.names, variant.poses(rows[0])),
        "tool": (variant.tool_names, variant.tool(rows[1][:, :3])),
        "outline": ("x,y", variant.outline(pushed[0].shape.outline)),
    }
    files = []
    for stem, (names, content) in tables.items():
        files.append(table_file(tmp_path / f"{stem}.csv", names, content, separator=variant.separator, digits=17))
        variant.files(files[-1])

    def imported(bag: str, *more: object) -> str:
        """What the import says, and what is wrong with its pushes by what they hold."""
        poses, tool, outline = files
        given = ("--pusher", tool, "--outline", outline, "--radius", 0.008, "--cell-size", 0.011, "--out", tmp_path / bag)
        done = run_here("import", "csv", poses, *given, *more)
        assert "Traceback" not in done.stderr
        return "" if done.returncode == 0 and "warning" not in done.stderr else " ".join(done.stderr.split())

    said = imported("bag", *variant.given)
    assert variant.says in said if variant.says else not said, said
    if variant.says and variant.remedy is None:
        return
    if variant.says:
        said = imported("again", *variant.remedy or ())
        assert not said, said
    pushes = split_pushes(read_bag(tmp_path / ("again" if variant.says else "bag")), "1")
    assert len(pushes) == len(pushed) and check_records(pushes).warnings == ()
    for push, record in zip(pushes, pushed, strict=True):
        np.testing.assert_allclose(push.pusher.position[[0, -1]], record.pusher.position[[0, -1]], atol=1e-3)
        np.testing.assert_allclose(push.poses.pose[[0, -1], :2], record.poses.pose[[0, -1], :2], atol=2e-3)
