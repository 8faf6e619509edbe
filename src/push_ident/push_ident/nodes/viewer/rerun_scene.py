"""The content of the live viewer, written with Rerun; what a bag shows there without nodes: `offline/bag_view.py`.

Entities are named by the frame they live in: `table` holds everything; `table/camera` is the depth camera, so that whatever stands on
the table can also be drawn into its picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from push_ident.errors import InputError
from push_ident.geometry.se2 import rotation, transform_points
from push_ident.limits import plain_text
from push_ident.nodes.convert.markers import GoalDrawing
from push_ident.nodes.viewer.rerun_server import RerunServer
from push_ident.nodes.viewer.settings import VIEWER
from push_ident.types import CameraIntrinsics, Float64Array

_OBSERVED, _PREDICTED, _EXPECTED, _UNIFORM, _TOOL, _NEXT, _GOAL = (
    [0, 158, 115],
    [213, 94, 0],
    [230, 159, 0],
    [140, 140, 140],
    [0, 114, 178],
    [204, 121, 167],
    [240, 228, 66],
)
"""Colours for all kinds of colour vision (Okabe and Ito)."""
_REFUSED: Final = [86, 180, 233]
"""Of what is no object; from the same colours."""
_EDGE: Final = _PREDICTED
"""Of the table, where a goal is at one; from the same colours."""


@dataclass(frozen=True, slots=True)
class CellMap:
    """Maps of one object as they are drawn."""

    cells: Float64Array
    """Centres in the object frame [m], shape (n, 2)."""
    size: float
    """Edge of a cell [m]."""
    load: Float64Array
    """Mass times friction [kg], shape (n,)."""
    deviation: Float64Array
    """Its standard deviation."""
    centre: Float64Array
    """Centre of friction in the object frame [m], shape (2,)."""


class RerunScene:
    """One recording; every method adds one entity, at the time set last."""

    def __init__(self, application: str = "push_ident") -> None:
        import rerun

        self._rr = rerun
        self._stream = rerun.RecordingStream(application)
        self._part: Float64Array | None = None
        self._is_whole = False
        self._server: RerunServer | None = None
        self._log("table", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, colour, label in (
            ("error", _PREDICTED, "predicted before the push"),
            ("expected", _EXPECTED, "expected by the prediction"),
            ("uniform", _UNIFORM, "equal cells"),
        ):
            look: dict[str, Any] = {"colors": colour, "names": label}
            self._log(f"error_mm/{name}", rerun.SeriesLines(**look), rerun.SeriesPoints(**look, marker_sizes=4), static=True)

    # ---- where it goes

    def serve(self, *, bind: str, grpc_port: int, web_port: int, memory: str) -> str:
        """Serve viewers over gRPC, and a viewer for the browser, on the address `bind`; what to open in a browser of this machine."""
        self._server = RerunServer(bind=bind, grpc_port=grpc_port, web_port=web_port, memory=memory)
        self.connect(self._server.url)
        return self._server.page

    def connect(self, address: str) -> None:
        """Send to a viewer that runs already; an empty address is the usual one of this machine."""
        self._stream.connect_grpc(address or None, default_blueprint=self._layout())

    def save(self, path: str) -> None:
        """Write a file that a viewer opens later. Raises InputError where the name is a link: Rerun would follow it."""
        if Path(path).is_symlink():
            raise InputError(f"{plain_text(path)} is a link, expected a new file or one to replace.")
        self._stream.save(path, default_blueprint=self._layout())

    def close(self) -> None:
        """Send what is still held back, then end the recording."""
        self._stream.flush(timeout_sec=VIEWER.flush_within)
        self._stream.disconnect()
        if self._server is not None:
            self._server.close()

    # ---- what is shown

    def set_time(self, stamp: float) -> None:
        """Of what follows [s]."""
        self._stream.set_time("time", duration=stamp)

    def camera(self, intrinsics: CameraIntrinsics, camera_in_table: Float64Array) -> None:
        """Where the camera stands: optical frame in `table`, shape (4, 4).

        The picture shows the middle of the table; that of a camera that moves shows all it sees.
        """
        rr = self._rr
        corners = np.array([[x, y, 0.0] for x in (-VIEWER.shown, VIEWER.shown) for y in (-VIEWER.shown, VIEWER.shown)])
        in_camera = (corners - camera_in_table[:3, 3]) @ camera_in_table[:3, :3]
        if np.all(in_camera[:, 2] > 0):
            pixels = in_camera[:, :2] / in_camera[:, 2:] * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]
            self._show_part(np.array([pixels.min(axis=0), pixels.max(axis=0)]))
        self._log("table/camera", rr.Transform3D(translation=camera_in_table[:3, 3], mat3x3=camera_in_table[:3, :3]))
        matrix = [[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]]
        self._log("table/camera", rr.Pinhole(image_from_camera=matrix, resolution=[intrinsics.width, intrinsics.height]))

    def _show_part(self, part: Float64Array) -> None:
        """Show a part of the picture, its corners [pixels], shape (2, 2), until it moves.

        Two layouts at most: Rerun keeps half a megabyte of each.
        """
        if self._part is None and not self._is_whole:
            self._part = part
        elif self._part is not None and np.abs(part - self._part).max() > VIEWER.steady * np.ptp(self._part):
            self._part, self._is_whole = None, True
        else:
            return
        self._stream.send_blueprint(self._layout())

    def depth(self, depth: NDArray[np.float32]) -> None:
        """A depth image [m], NaN where nothing was measured."""
        millimetres = np.nan_to_num(1e3 * depth, nan=0.0, posinf=0.0, neginf=0.0).clip(0, 65535).astype(np.uint16)
        measured = millimetres[millimetres > 0]
        near, far = (float(v) for v in np.quantile(measured[::17], (0.01, 0.99))) if len(measured) > 17 else (0.0, 1.0)
        self._log(
            "table/camera/depth",
            self._rr.DepthImage(millimetres, meter=1000.0, colormap="grayscale", depth_range=(near - 50.0, far + 20.0)),
        )

    def tool(self, position: Float64Array, radius: float) -> None:
        """The tip of the tool [m], shape (3,), and its radius [m]."""
        rr = self._rr
        self._log("table/tool", rr.Points3D([position], radii=[max(radius, 0.004)], colors=_TOOL))

    def observed(self, object_id: str, outline: Float64Array, pose: Float64Array, top: float) -> None:
        """The observed pose of an object: outline (n, 2) in its frame, pose (x, y, yaw), height of its upper side [m]."""
        self._log(f"table/objects/{object_id}/observed", self._lines([transform_points(pose, outline)], top + 2 * VIEWER.lift, _OBSERVED))
        turn = np.eye(3)
        turn[:2, :2] = rotation(pose[2])
        placed = self._rr.Transform3D(translation=[pose[0], pose[1], top + VIEWER.lift], mat3x3=turn)
        for name in ("load", "uncertainty"):
            self._log(f"table/{name}/{object_id}", placed)

    def refused(self, refusals: list[tuple[Float64Array, str]]) -> None:
        """What perception did not take in as an object: outlines (n, 3) in `table`, with the reason; they replace those shown before."""
        name = "table/objects/refused"
        if not refusals:
            self._log(name, self._rr.Clear(recursive=True))
            return
        # The reason without the remedy: longer labels hide the object.
        labels = [why.partition(";")[0] for _, why in refusals]
        lines = self._rr.LineStrips3D(
            [outline for outline, _ in refusals], labels=labels, colors=_REFUSED, radii=VIEWER.line_width, show_labels=True
        )
        self._log(name, lines)

    def map(self, object_id: str, cells: CellMap) -> None:
        """Friction load of each cell and its relative standard deviation; both follow the object."""
        relative = cells.deviation / np.maximum(cells.load, 1e-12)
        for name, share, palette in (
            ("load", cells.load / max(float(cells.load.max()), 1e-12), cv2.COLORMAP_VIRIDIS),
            ("uncertainty", np.clip(relative, 0.0, 1.0), cv2.COLORMAP_MAGMA),
        ):
            self._log(f"table/{name}/{object_id}/cells", self._cells(cells, share, palette))
            centre = self._rr.Points3D([[*cells.centre, VIEWER.lift]], radii=[0.35 * cells.size], colors=[220, 30, 30])
            self._log(f"table/{name}/{object_id}/centre", centre)

    def predicted(self, object_id: str, outline: Float64Array, poses: Float64Array, top: float) -> None:
        """A predicted motion, poses (n, 3), as outlines along it; no poses remove it."""
        chosen = np.unique(np.linspace(0, len(poses) - 1, min(VIEWER.n_outlines, len(poses))).astype(int))
        ghosts = [transform_points(poses[i], outline) for i in chosen]
        self._log(f"table/objects/{object_id}/predicted", self._lines(ghosts, top + 3 * VIEWER.lift, _PREDICTED))

    def next_push(self, object_id: str, path: Float64Array, top: float) -> None:
        """Path (n, 2) of the tool in the push to make next; an empty one removes it."""
        rr = self._rr
        name = f"table/objects/{object_id}/next_push"
        if len(path) < 2:
            self._log(name, rr.Clear(recursive=True))
            return
        start, end = ([*path[i], top + 3 * VIEWER.lift] for i in (0, -1))
        self._log(
            f"{name}/tool", rr.Arrows3D(origins=[start], vectors=[np.subtract(end, start)], colors=_NEXT, radii=VIEWER.line_width * 1.5)
        )

    def next_end(self, object_id: str, outline: Float64Array, top: float) -> None:
        """Where the next push would leave the object: outline (n, 2) in `table`."""
        self._log(f"table/objects/{object_id}/next_push/end", self._lines([outline], top + 3 * VIEWER.lift, _NEXT))

    def goal(self, drawing: GoalDrawing | None, top: float) -> None:
        """The goal or path that is pursued and the current push, instead of the suggested next push; None removes them."""
        rr, name = self._rr, "table/objects/goal"
        self._log(name, rr.Clear(recursive=True))
        if drawing is None:
            return
        height = top + 4 * VIEWER.lift
        self._log(f"{name}/outline", self._lines([drawing.goal], height, _GOAL))
        for part, line, colour in (("edge", drawing.edge, _EDGE), ("path", drawing.path, _GOAL)):
            if line is not None:
                self._log(f"{name}/{part}", self._lines([line], height, colour, closed=False))
        labels = [(drawing.goal, drawing.words, _GOAL)]
        if drawing.tool is not None and drawing.end is not None:
            # Of a tool that is steered the arrow is the end of its path.
            start, end = ([*point, height] for point in drawing.tool[-2:])
            self._log(
                f"{name}/push/tool",
                rr.Arrows3D(origins=[start], vectors=[np.subtract(end, start)], colors=_NEXT, radii=VIEWER.line_width * 1.5),
            )
            if len(drawing.tool) > 2:
                self._log(f"{name}/push/path", self._lines([drawing.tool], height, _NEXT, closed=False))
            if drawing.corridor is not None:
                self._log(f"{name}/push/corridor", self._lines([drawing.corridor], height, _UNIFORM))
            self._log(f"{name}/push/end", self._lines([drawing.end], height, _NEXT))
            labels.append((drawing.end, drawing.chance, _NEXT))
        for number, (corners, text, colour) in enumerate(labels):
            # At different corners, so that the words of a push that ends at the goal do not hide those of the goal.
            corner = corners[np.argmin(corners[:, 1]) if number else np.argmax(corners[:, 1])]
            self._log(
                f"{name}/words/{number}",
                rr.Points3D([[*corner, height]], radii=VIEWER.line_width, colors=colour, labels=text, show_labels=True),
            )

    def score(self, error: float, expected: float, uniform: float) -> None:
        """Cell errors of one push [m]: of the prediction made before it, what that expected of itself, and of equal cells."""
        for name, value in (("error", error), ("expected", expected), ("uniform", uniform)):
            if np.isfinite(value):
                self._log(f"error_mm/{name}", self._rr.Scalars(1e3 * value))

    def status(self, markdown: str) -> None:
        """What is known, for reading."""
        self._log("status", self._rr.TextDocument(markdown, media_type="text/markdown"))

    # ---- inside

    def _log(self, entity: str, *what: Any, static: bool = False) -> None:
        self._stream.log(entity, *what, static=static)

    def _lines(self, lines: list[Float64Array], height: float, colour: list[int], *, closed: bool = True) -> Any:
        """Lines through points, each of shape (n, 2); `closed`: back to the first one."""
        flat = [np.vstack([line, line[:1]]) if closed else line for line in lines]
        strips = [np.column_stack([line, np.full(len(line), height)]) for line in flat]
        return self._rr.LineStrips3D(strips, colors=[colour] * len(strips), radii=[VIEWER.line_width] * len(strips))

    def _cells(self, cells: CellMap, share: Float64Array, palette: int) -> Any:
        """Squares coloured by `share` from 0 to 1, shape (n,)."""
        colours = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8)[:, None], palette)[:, 0, ::-1]
        corners = 0.47 * cells.size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        flat = (cells.cells[:, None] + corners).reshape(-1, 2)
        first = 4 * np.arange(len(cells.cells))[:, None]
        triangles = (first[:, :, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        return self._rr.Mesh3D(
            vertex_positions=np.column_stack([flat, np.zeros(len(flat))]),
            triangle_indices=triangles,
            vertex_colors=np.repeat(colours, 4, axis=0),
        )

    def _layout(self) -> Any:
        import rerun.blueprint as layout

        on_table = ["+ table/camera/**", "+ table/tool", "+ table/objects/**"]
        bounds = None
        if self._part is not None:
            (left, top), (right, bottom) = self._part
            bounds = layout.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])
        above = layout.EyeControls3D(position=(0.75, 0.0, 0.55), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0))
        return layout.Blueprint(
            layout.Vertical(
                layout.Horizontal(
                    *(
                        layout.Spatial2DView(
                            name=title, origin="table/camera", contents=[*on_table, f"+ table/{what}/**"], visual_bounds=bounds
                        )
                        for what, title in (
                            ("load", "Camera, and friction force of each cell (yellow: largest)"),
                            ("uncertainty", "Relative deviation of it (black: known, white: unknown)"),
                        )
                    )
                ),
                layout.Horizontal(
                    layout.Spatial3DView(
                        name="Observed (green), predicted (orange), next push (pink), its corridor (grey), goal and path (yellow), "
                        "edge of the table (orange)",
                        origin="table",
                        contents=[*on_table, "+ table/load/**"],
                        eye_controls=above,
                    ),
                    layout.TimeSeriesView(
                        name="Cell error at the end of each push [mm]", origin="error_mm", plot_legend=layout.Corner2D.RightTop
                    ),
                    layout.TextDocumentView(name="State", origin="status"),
                    column_shares=[3, 3, 2],
                ),
                row_shares=[3, 2],
            ),
            layout.TimePanel(play_state="Following", state="collapsed"),
            collapse_panels=True,
        )
