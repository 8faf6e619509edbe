"""Damaged files of every text format: a bag or one line, never a traceback. Seeds are fixed, so that a failure can be repeated."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree

import numpy as np
import pytest

from helpers.recordings import icra16_file, mit_content, mit_file
from push_ident.bags.importers import MitOptions, TrackedPoses, import_cmu_icra16, import_mit, import_tracked_poses
from push_ident.errors import PushIdentError
from push_ident.types import PushRecord

N_MUTANTS = 60
TOKENS = [b"nan", b"inf", b"-1", b"1e300", b"0", b"999999999999999999999", b"x", b",", b"\n", b'"', b"[", b"{", b"\x00", b"\xff", b"-0.0"]


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """One or two places overwritten, cut out, doubled or cut off."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 3)):
        at, length = int(rng.integers(len(data) + 1)), int(rng.integers(1, 30))
        kind, token = rng.integers(5), TOKENS[rng.integers(len(TOKENS))]
        if kind == 0:
            data[at : at + length] = token
        elif kind == 1:
            data[at:at] = token
        elif kind == 2:
            del data[at : at + length]
        elif kind == 3:
            data[at:at] = data[max(0, at - 200) : at]
        else:
            del data[at:]
    return bytes(data)


@pytest.mark.parametrize("damaged", ["icra16", "mit", "poses", "pusher", "outline"])
def test_damaged_file_gives_a_bag_or_one_line(damaged: str, tables: TrackedPoses, pushed: list[PushRecord], tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    square = MitOptions(outline=np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]))
    icra16, mit = icra16_file(tmp_path / "patch" / "pushes.txt"), mit_file(tmp_path / "mit", mit_content(pushed[0]))
    cases: dict[str, tuple[Path, Callable[[], object]]] = {
        "icra16": (icra16, lambda: import_cmu_icra16(icra16, bag)),
        "mit": (mit, lambda: import_mit([mit], bag, options=square)),
        "poses": (tables.poses, lambda: import_tracked_poses(tables, bag)),
        "pusher": (tables.pusher, lambda: import_tracked_poses(tables, bag)),
        "outline": (tables.outline, lambda: import_tracked_poses(tables, bag)),
    }
    file, convert = cases[damaged]
    whole = file.read_bytes()
    convert()
    rmtree(bag)
    for seed in range(N_MUTANTS):
        file.write_bytes(mutated(whole, np.random.default_rng(seed)))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                convert()
                rmtree(bag)
            except PushIdentError as error:
                assert "\n" not in str(error), seed
                assert not bag.exists(), seed
