"""`push-ident selftest` as its users and their scripts see it."""

from __future__ import annotations

import json
from pathlib import Path

from helpers.commands import check_refused, run_here
from helpers.objects import hammer, random_records
from push_ident.bags.records import write_records


def test_selftest_writes_table_json_and_page(tmp_path: Path) -> None:
    bag, page = tmp_path / "hammer", tmp_path / "page.html"
    write_records(bag, random_records(hammer(2), 5, 2))
    done = run_here("selftest", bag, "--without", "4", "--maps", 1, "--seconds", 1, "--json", tmp_path / "s.json", "--page", page)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "s.json").read_text())
    assert content["n_pushes"] == 4 and content["options"] == {"seconds": 1.0, "maps": 1, "seed": 0} and content["n_objects"] == 1
    assert content["end_error_m"] < content["end_error_before_m"]
    assert next(e for e in content["effects"] if e["name"] == "restitution")["smallest"] is None
    assert "centre of friction x" in done.stdout and "would help: Weigh the object" in done.stdout
    assert "not tried: proof of" in done.stderr and "push 4 is left out" in done.stderr
    html = page.read_text(encoding="utf-8")
    assert all(heading in html for heading in ("What they tell", "What they do not tell", "What would help", "Known effects"))
    check_refused("--without names push 6", "selftest", bag, "--without", "6")
