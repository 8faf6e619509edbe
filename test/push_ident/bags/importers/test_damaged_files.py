"""Damaged files of every text format: a bag or one line, never a traceback."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from shutil import rmtree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.fuzzing import fuzzed
from helpers.motion_capture import motive, qualisys, tracked_bodies, vicon
from helpers.recordings import icra16_file, mit_content, mit_file
from push_ident.bags.importers import MitOptions, TrackedPoses, import_cmu_icra16, import_mit, import_tracked_poses
from push_ident.errors import PushIdentError
from push_ident.types import Float64Array, PushRecord

TOKENS = [b"", b"nan", b"inf", b"-1", b"1e300", b"0", b"9" * 21, b"x", b",", b"\n", b'"', b"[", b"{", b"\x00", b"\xff", b"-0.0"]


@st.composite
def damage(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """A place overwritten, cut out, doubled or cut off."""
    share, length, token = draw(st.floats(0, 1)), draw(st.sampled_from([0, 1, 9, 30, 10**9])), draw(st.sampled_from(TOKENS))
    doubled = draw(st.sampled_from([0, 0, 200]))

    def change(data: bytes) -> bytes:
        at = int(share * len(data))
        return data[:at] + token + data[max(0, at - doubled) : at] + data[at + length :]

    return change


@pytest.mark.fuzz
@pytest.mark.parametrize("damaged", ["icra16", "mit", "poses", "pusher", "outline", "motive", "vicon", "qualisys"])
def test_damaged_file_gives_a_bag_or_one_line(
    damaged: str, tables: TrackedPoses, rows: tuple[Float64Array, Float64Array], pushed: list[PushRecord], tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    square = MitOptions(outline=np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]))
    icra16, mit = icra16_file(tmp_path / "patch" / "pushes.txt"), mit_file(tmp_path / "mit", mit_content(pushed[0]))
    take = {"motive": motive("XYZ"), "vicon": vicon(), "qualisys": qualisys()}.get(damaged, motive())(
        tmp_path / "take", *tracked_bodies(rows, "x,y,z")
    )
    of_bodies = replace(tables, poses=Path(f"{take}#My box"), pusher=Path(f"{take}#Tool"), axes=np.eye(3))
    cases: dict[str, tuple[Path, Callable[[], object]]] = {
        "icra16": (icra16, lambda: import_cmu_icra16(icra16, bag)),
        "mit": (mit, lambda: import_mit([mit], bag, options=square)),
        "poses": (tables.poses, lambda: import_tracked_poses(tables, bag)),
        "pusher": (tables.pusher, lambda: import_tracked_poses(tables, bag)),
        "outline": (tables.outline, lambda: import_tracked_poses(tables, bag)),
        **dict.fromkeys(("motive", "vicon", "qualisys"), (take, lambda: import_tracked_poses(of_bodies, bag))),
    }
    file, convert = cases[damaged]
    whole = file.read_bytes()

    @fuzzed(20 if damaged in ("motive", "vicon", "qualisys") else 60)  # their files are long
    @given(damage())
    def check(change: Callable[[bytes], bytes]) -> None:
        file.write_bytes(change(whole))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                convert()
                rmtree(bag)
            except PushIdentError as error:
                assert "\n" not in str(error)
                assert not bag.exists()

    convert()
    rmtree(bag)
    check()
