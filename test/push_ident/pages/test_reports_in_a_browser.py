"""Reports in a real browser: readable on a telephone, on a wide screen, in the dark and on paper."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

from helpers.commands import run_here
from helpers.depth_scene import CAMERA, box, render
from helpers.diagnosis import simulated_pushes
from helpers.objects import hammer, random_records
from helpers.recordings import table_file, tracked_rows
from push_ident.bags.importers import TrackedPoses, import_tracked_poses
from push_ident.bags.importers.import_page import write_import_page
from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.report import write_report as write_diagnosis
from push_ident.fleet import write_index
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import PushErrors, push_errors
from push_ident.identification.report import Provenance, write_report
from push_ident.identification.report.result_json import result_json
from push_ident.identification.results.result import Identification
from push_ident.planning.goal_page import write_goal_page
from push_ident.types import CameraIntrinsics, PushRecord

ANSWER = 60.0
"""Longest wait for an answer of the browser [s]; a loaded machine is slow."""


def installed() -> str:
    """The browser: `PUSH_IDENT_CHROMIUM`, else one on the path; the test is skipped where there is none."""
    found = os.environ.get("PUSH_IDENT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("Chromium is not installed; install it, or name it in PUSH_IDENT_CHROMIUM")
    return found


class Tab:
    """One page of the browser."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._numbers, self._session = socket, itertools.count(1), None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Page.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        """One command and its result; events in between are left unread."""
        number = next(self._numbers)
        session = {} if self._session is None else {"sessionId": self._session}
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters, **session}))
        while True:
            answer = json.loads(self._socket.recv(timeout=ANSWER))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def show(self, page: Path, width: int, *, dark: bool = False) -> None:
        """Load a page in a window of this width [CSS px]."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        scheme = "dark" if dark else "light"
        self.call("Emulation.setEmulatedMedia", media="", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self.call("Page.navigate", url=page.as_uri())
        self.value("new Promise(done => document.readyState === 'complete' ? done(1) : addEventListener('load', () => done(1)))")

    def value(self, expression: str) -> Any:
        """What an expression of JavaScript gives in the page."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def printed_pages(self) -> int:
        """Number of A4 pages of the print."""
        pdf = base64.b64decode(self.call("Page.printToPDF", paperWidth=8.27, paperHeight=11.69, printBackground=False)["data"])
        return len(re.findall(rb"/Type\s*/Page\b", pdf))


@contextlib.contextmanager
def tab(scratch: Path) -> Iterator[Tab]:
    """A browser with one page, its profile in `scratch`."""
    options = ["--headless=shell", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--remote-debugging-port=0"]
    command = [installed(), *options, f"--user-data-dir={scratch / 'profile'}", "about:blank"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        assert process.stderr is not None
        address = next((found[1] for line in process.stderr if (found := re.search(r"DevTools listening on (ws://\S+)", line))), None)
        assert address is not None, "the browser did not start"
        with connect(address, max_size=2**27, open_timeout=ANSWER) as socket:
            yield Tab(socket)
    finally:
        process.kill()
        process.wait()


pytestmark = pytest.mark.release
SMALLEST_TEXT = 11.0
"""[CSS px]; smaller letters are hard to read."""
CONTRAST = 4.5
"""Least ratio of luminances of text and ground (WCAG 2.2, 1.4.3)."""
MOST_PAGES = {"identification": 4, "diagnosis": 5, "goal": 3, "fleet": 2, "look": 3, "import": 3}
"""Of A4, for a handful of pushes."""
NAMES = list(MOST_PAGES)
WIDER = "letter-spacing: 0.04em"
"""Style of text as wide as the widest fonts of the family have it."""

TEXT_SIZES = """
[...document.querySelectorAll('svg.chart text, td, th, p, code, figcaption, span')].filter(e => e.textContent.trim()).map(e => {
  const svg = e.closest('svg');
  const scale = svg ? svg.getBoundingClientRect().width / svg.viewBox.baseVal.width : 1;
  return parseFloat(getComputedStyle(e).fontSize) * scale;
}).reduce((a, b) => Math.min(a, b))
"""
OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
HIDDEN = """
[...document.querySelectorAll('.wide, figure')].filter(e => e.scrollWidth > e.clientWidth + 1).map(e => e.textContent.trim().slice(0, 60))
"""
CONTRASTS = """
(() => {
  const light = text => {
    const [r, g, b] = text.match(/[\\d.]+/g).map(v => Number(v) / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = e => {
    for (; e; e = e.parentElement) {
      const colour = getComputedStyle(e).backgroundColor;
      if (!colour.startsWith('rgba(0, 0, 0, 0')) return colour;
    }
    return 'rgb(255, 255, 255)';
  };
  const ratios = [...document.querySelectorAll('svg.chart text, td, th, p, figcaption, h1, h2')].map(e => {
    const ink = getComputedStyle(e)[e.closest('svg') ? 'fill' : 'color'];
    const [a, b] = [light(ink), light(ground(e))].sort((x, y) => y - x);
    return (a + 0.05) / (b + 0.05);
  });
  return Math.min(...ratios);
})()
"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    records = random_records(hammer(3), 6, 3)
    result = identify(records[:4])
    errors = [push_errors(result, records, pushes) for pushes in ((0, 1, 2, 3), (4, 5))]
    sources = tuple(f"bag push {number}" for number in range(1, 5))
    write_report(folder / "identification.html", result, *errors, Provenance("o1", sources), 0.01)
    tilted = diagnose(simulated_pushes(8, 1, {"table_tilt": [0.02, 0.0]}))
    write_diagnosis(folder / "diagnosis.html", tilted, object_id="o1", sources=sources)
    write_goal_page(folder / "goal.html", goal_content())
    write_index(folder / "fleet.html", fleet(result, *errors))
    look(folder)
    import_with_a_wrong_radius(folder, records)
    return {path.stem: path for path in folder.glob("*.html")}


def fleet(result: Identification, train: PushErrors, test: PushErrors) -> list[dict[str, object]]:
    """Outcomes of four bags, one of which failed."""
    done = {"state": "done", "error": "", "result": result_json(result, "o1", train, test, []), "page_file": "pages/a.html"}
    done |= {"host": "workstation", "seconds": 2.1, "model_file": "models/a.json"}
    failed = {"state": "failed", "error": "in none of its 6 pushes the object moves; see the note on clocks.", "host": "workstation"}
    failed |= {"bag": "recordings/noise.mcap", "seconds": 0.4}
    return [*(done | {"bag": f"recordings/2026/cell_2/monday_{k}.mcap"} for k in range(3)), failed]


def look(folder: Path) -> None:
    """What `push-ident look` writes of a box, and of one that is partly hidden behind a taller one."""
    scene = [box(-0.12, 0.0, 0.12, 0.08, 0.05, 0.4), box(0.12, 0.12, 0.12, 0.08, 0.05), box(0.12, -0.01, 0.06, 0.08, 0.15, 0.1)]
    intrinsics = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
    (folder / "images").mkdir()
    for number in range(2):
        depth = render(scene, CAMERA, rng=np.random.default_rng(number), intrinsics=intrinsics).depth
        cv2.imwrite(str(folder / "images" / f"{number}.png"), np.rint(np.nan_to_num(depth) * 1e3).astype(np.uint16))
    given = ("--intrinsics", "300,300,159.5,119.5", "--known", "0.12x0.08x0.05", "--out", folder)
    done = run_here("look", folder / "images", *given)
    assert done.returncode == 0, done.stderr


def import_with_a_wrong_radius(folder: Path, records: list[PushRecord]) -> None:
    poses, pusher = tracked_rows(records)
    files = {
        "poses": table_file(folder / "poses.csv", "time,x,y,yaw", poses),
        "pusher": table_file(folder / "pusher.csv", "time,x,y,push", pusher),
        "outline": table_file(folder / "outline.csv", "x,y", records[0].shape.outline),
    }
    given = TrackedPoses(**files, radius=0.020, position_std=1e-3, yaw_std=8.7e-3, cell_size=0.011)
    write_import_page(folder / "import.html", import_tracked_poses(given, folder / "bag"), "poses.csv, pusher.csv, outline.csv")


def goal_content() -> dict[str, object]:
    """What `push-to --json` writes of a goal at an edge that was given up after four pushes."""
    poses = np.linspace([0.0, -0.05, -0.5], [0.048, 0.055, 0.62], 5).tolist()
    error = {"position_error_m": 0.1, "yaw_error_rad": 0.5}
    first = {"number": 1, "seen": poses[1], "expected": None, "chance": None, "risk": None} | error
    later = [{"number": k, "seen": poses[k], "expected": poses[k], "chance": 0.2 * k, "risk": 0.001 * k} | error for k in (2, 3, 4)]
    ended = {"reached": False, "code": "CANCELED", "text": "broken off before it ended: the arm holds.", "n_pushes": 4, "time_s": 41.0}
    goal = {"object_id": "o1", "goal": [0.05, 0.06, 0.6], "tolerance_m": 0.02, "tolerance_rad": 0.1, "start": poses[0]}
    at_edge = {"kind": "edge", "edge": [[0.09, -0.4], [0.09, 0.4]], "wanted_overhang_m": 0.04, "wanted_margin_m": 0.01}
    at_edge |= {"overhang_m": 0.037, "margin_m": 0.024}
    return ended | goal | error | at_edge | {"outline": hammer(3).shape.outline.tolist(), "pushes": [first, *later]}


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with tab(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.mark.parametrize("name", NAMES)
def test_page_is_readable_and_printed_on_few_sheets_and_every_figure_has_a_title(pages: dict[str, Path], browser: Tab, name: str) -> None:
    for width, dark in ((380, False), (820, True), (1600, False)):
        browser.show(pages[name], width, dark=dark)
        assert browser.value(OVERFLOW) <= 0 and browser.value(HIDDEN) == [], width
        browser.value(f"document.body.style.cssText = '{WIDER}'")
        assert browser.value(OVERFLOW) <= 0 and browser.value(HIDDEN) == [], (width, "with another font of the family")
        assert browser.value(TEXT_SIZES) >= SMALLEST_TEXT and browser.value(CONTRASTS) >= CONTRAST, width
    assert browser.value("[...document.querySelectorAll('figure')].every(f => f.querySelector('figcaption').textContent.length > 10)")
    assert browser.value("[...document.querySelectorAll('svg.chart')].every(s => s.querySelector('title'))")
    if name == "identification":
        cells = "[...document.querySelectorAll('svg.chart rect title')].filter(t => /^cell 1 at .* mm: /.test(t.textContent))"
        assert browser.value(f"{cells}.length") == 5
    browser.show(pages[name], 1600, dark=True)
    assert 1 <= browser.printed_pages() <= MOST_PAGES[name]
    browser.call("Emulation.setEmulatedMedia", media="print", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    assert browser.value("getComputedStyle(document.documentElement).getPropertyValue('--ink').trim()") == "#1c2430"
