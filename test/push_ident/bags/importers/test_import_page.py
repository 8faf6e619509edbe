"""The page of an import says whether pusher and object meet, what was imported and what to do next."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np

from push_ident.bags.importers import TrackedPoses, import_tracked_poses
from push_ident.bags.importers.import_page import write_import_page
from push_ident.types import PushRecord

NAME = "<b>bold</b> a&b;'x"


def page_of(tables: TrackedPoses, folder: Path) -> str:
    report = import_tracked_poses(tables, folder / "bag")
    write_import_page(folder / "page.html", replace(report, notes=(*report.notes, NAME)), NAME)
    raw = (folder / "page.html").read_text(encoding="utf-8")
    assert NAME not in raw and NAME in unescape(raw)
    return unescape(raw)


def columns(text: str, label: str) -> list[str]:
    """Cells of one column of the tables."""
    return re.findall(f'data-label="{label}"[^>]*>([^<]*)</td>', text)


def drawn(text: str, style: str) -> int:
    """Number of closed lines of a style in the figures."""
    return text.count(f'<polygon class="{style}"')


def test_page_of_a_right_import_leads_on_to_identify(tmp_path: Path, tables: TrackedPoses, pushed: list[PushRecord]) -> None:
    text = page_of(tables, tmp_path)
    assert "<h1>Import of bag: pusher and object meet</h1>" in text and "What is wrong" not in text
    assert set(columns(text, "result")) == {"good"} and columns(text, "pusher and outline") == ["meets"] * 6
    assert drawn(text, "meets") == 12 and drawn(text, "missed") == 0 and drawn(text, "outline") == 7
    ways = [1e3 * float(np.linalg.norm(push.poses.pose[-1, :2] - push.poses.pose[0, :2])) for push in pushed]
    np.testing.assert_allclose([float(way.split()[0]) for way in columns(text, "object moved")], ways, atol=1.5)
    assert f"push-ident identify {tmp_path / 'bag'} --train 0-3 --out out/bag_maps" in text
    assert "radius 8.0 mm" in text and f"{len(pushed[0].shape.cells)} cells" in text and "weigh the object" in text


def test_page_of_a_wrong_radius_says_what_to_mend_and_does_not_lead_on(tmp_path: Path, tables: TrackedPoses) -> None:
    text = page_of(replace(tables, radius=0.018), tmp_path)
    assert "pusher and object do not meet</h1>" in text and "What is wrong" in text
    assert re.search(r"Most likely: the radius of the pusher is (7|8)\.\d mm, not 18\.0 mm", text)
    assert "push-ident identify" not in text and "leave this bag aside" in text
    assert drawn(text, "missed") > 6 and columns(text, "pusher and outline").count("misses") > 3
    assert all(-13 < float(cell.split()[0]) < -7 for cell in columns(text, "while it moves"))
