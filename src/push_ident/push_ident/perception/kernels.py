"""Loops over pixels and over lines of sight, compiled.

Each kernel declares its argument types. Numba therefore compiles it, or reads it from its cache, when this module is imported: a node
that subscribes never waits for the compiler. A kernel and what it calls stay in one file, because numba's cache detects changes of a
kernel's own file only. The loops stay whole: splitting them would cost speed.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit, types

from push_ident.types import Float64Array


class Grid(NamedTuple):
    """Values at the nodes of a square grid. The kernels expect arrays that are writable and in C order."""

    values: Float64Array
    """Shape (rows, columns)."""
    origin: Float64Array
    """Position of the first node [m], shape (2,): node (row, column) lies at origin + step * (column, row)."""
    step: float
    """Distance between nodes [m]."""


def _read_only(element: Any, n_axes: int, layout: str = "C") -> Any:
    """Type of an array that the kernel only reads."""
    return types.Array(element, n_axes, layout, readonly=True)


_REAL: Final = types.float64
_REALS: Final = _read_only(types.float64, 1)
_ROWS: Final = _read_only(types.float64, 2)
_GRID: Final = types.NamedTuple((types.Array(types.float64, 2, "C"), types.Array(types.float64, 1, "C"), types.float64), Grid)
_IMAGE: Final = _read_only(types.float32, 2, "A")
_MASK: Final = _read_only(types.uint8, 2)
_POINTS: Final = _read_only(types.float32, 3)
_DEPTH: Final = _read_only(types.float32, 2)
_FLAGS: Final = _read_only(types.bool_, 2)
_NUMBERS: Final = _read_only(types.int32, 2)


def _kernel(*arguments: Any) -> Any:
    """Compile for these argument types; division by zero gives infinity, as in numpy."""
    return njit([arguments], cache=True, error_model="numpy")


_inline = njit(inline="always", error_model="numpy")


@_inline
def _row_and_column(grid: Any, x: Any, y: Any) -> Any:
    """Row and column of a point, in nodes, with fractions."""
    return (y - grid.origin[1]) / grid.step, (x - grid.origin[0]) / grid.step


@_inline
def _nearest_node(grid: Any, row: Any, column: Any) -> Any:
    """Value of the node nearest to a row and column; outside the grid, and for NaN, of a node on the border."""
    last_row, last_column = grid.values.shape[0] - 1, grid.values.shape[1] - 1
    i = 0 if not row > 0.0 else last_row if row >= last_row else int(row + 0.5)
    j = 0 if not column > 0.0 else last_column if column >= last_column else int(column + 0.5)
    return grid.values[i, j]


@_inline
def _nearest(grid: Any, x: Any, y: Any) -> Any:
    """Value of the node nearest to a point."""
    row, column = _row_and_column(grid, x, y)
    return _nearest_node(grid, row, column)


@_inline
def _bilinear(grid: Any, row: Any, column: Any) -> Any:
    """Bilinear value and its gradient at a row and column; outside the grid, those at the border."""
    values, step = grid.values, grid.step
    row = 0.0 if not row > 0.0 else min(row, values.shape[0] - 1.001)
    column = 0.0 if not column > 0.0 else min(column, values.shape[1] - 1.001)
    i, j = int(row), int(column)
    u, v = column - j, row - i
    along, along_above = values[i, j + 1] - values[i, j], values[i + 1, j + 1] - values[i + 1, j]
    below, above = values[i, j] + u * along, values[i + 1, j] + u * along_above
    return below + v * (above - below), (along + v * (along_above - along)) / step, (above - below) / step


@_inline
def _to_object(x: Any, y: Any, pose: Any, cos: Any, sin: Any) -> Any:
    """A point of the table frame in the object frame that `pose` places."""
    x, y = x - pose[0], y - pose[1]
    return cos * x + sin * y, cos * y - sin * x


@_inline
def _innermost(field: Any, upper: Any, lower: Any, pose: Any, cos: Any, sin: Any) -> Any:
    """The end of a line segment that lies further inside, object frame, and its row and column in the field.

    Choices between values cost less here than a branch, which the processor cannot predict; so does a row that is computed once.
    """
    upper_x, upper_y = _to_object(upper[0], upper[1], pose, cos, sin)
    lower_x, lower_y = _to_object(lower[0], lower[1], pose, cos, sin)
    upper_row, upper_column = _row_and_column(field, upper_x, upper_y)
    lower_row, lower_column = _row_and_column(field, lower_x, lower_y)
    is_upper = _nearest_node(field, upper_row, upper_column) < _nearest_node(field, lower_row, lower_column)
    x, y = upper_x if is_upper else lower_x, upper_y if is_upper else lower_y
    return x, y, upper_row if is_upper else lower_row, upper_column if is_upper else lower_column


@_inline
def _jump(towards: Any, visibility: Any) -> Any:
    """How far a camera takes an edge for a jump of depth, from 0 to 1, that is `towards` it along its outward normal [m]: wholly where its
    wall is hidden, not at all where that fills half of a matcher's window; `visibility` is the share of it by metre [1/m]."""
    return min(1.0, max(0.0, 1.0 - visibility * towards))


@_inline
def _expected(field: Any, upper: Any, lower: Any, pose: Any, cos: Any, sin: Any, width: Any, edges: Any) -> Any:
    """Innermost end of a line of sight, object frame, its distance from where the camera shows the outline [m], the expected, and the
    derivatives of that by the pose."""
    x, y, row, column = _innermost(field, upper, lower, pose, cos, sin)
    distance, along_x, along_y = _bilinear(field, row, column)
    if edges[2] > 0.0:
        camera_x = cos * (edges[0] - pose[0]) + sin * (edges[1] - pose[1])
        camera_y = -sin * (edges[0] - pose[0]) + cos * (edges[1] - pose[1])
        distance -= edges[2] * _jump(along_x * (camera_x - x) + along_y * (camera_y - y), edges[3])
    expected = 1.0 / (1.0 + math.exp(distance / width))
    steepness = expected * (1.0 - expected) / width
    by_x, by_y = steepness * (cos * along_x - sin * along_y), steepness * (sin * along_x + cos * along_y)
    return x, y, distance, expected, by_x, by_y, -steepness * (along_x * y - along_y * x)


@_kernel(_GRID, _ROWS)
def nearest_values(grid: Any, points: Any) -> Any:
    """Values, shape (n,), of the nodes nearest to points (n, 2)."""
    result = np.empty(len(points))
    for i in range(len(points)):
        result[i] = _nearest(grid, points[i, 0], points[i, 1])
    return result


@_kernel(_GRID, _ROWS)
def interpolate(grid: Any, points: Any) -> Any:
    """Bilinear values, shape (n,), and gradients, shape (n, 2), at points (n, 2)."""
    value, gradient = np.empty(len(points)), np.empty((len(points), 2))
    for i in range(len(points)):
        row, column = _row_and_column(grid, points[i, 0], points[i, 1])
        value[i], gradient[i, 0], gradient[i, 1] = _bilinear(grid, row, column)
    return value, gradient


@_kernel(_GRID, _ROWS, _ROWS, _REALS)
def innermost_points(field: Any, upper: Any, lower: Any, pose: Any) -> Any:
    """For each line the end that lies further inside the outline at `pose`, object frame, shape (n, 2)."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    result = np.empty((len(upper), 2))
    for i in range(len(upper)):
        result[i, 0], result[i, 1], _, _ = _innermost(field, upper[i], lower[i], pose, cos, sin)
    return result


@_kernel(_GRID, _GRID, _IMAGE, _MASK, _POINTS, _REALS, _REALS, types.UniTuple(types.int64, 5), types.UniTuple(types.float64, 4))
def intersect_object(field: Any, tops: Any, depth: Any, left_out: Any, rays: Any, centre: Any, pose: Any, box: Any, limits: Any) -> Any:
    """Intersect the lines of sight of the pixels in `box` with the heights of the object at `pose`.

    Args:
        field: Signed distance to the outline [m].
        tops: Height of the upper side [m].
        depth, rays, centre: As of `FrameView`.
        left_out: Which pixels of the box are not used, 1, shape (rows, columns) of the box.
        box: First and end row, first and end column, stride.
        limits: Mean height of the top; largest distance from the outline at that height; how far below the top a line counts as
            stopped; how far above the top a point belongs to something in front [m].

    Returns:
        Per line within that distance: where it passes the top and a little below, shapes (n, 2); the point that it measured, shape
        (n, 3); whether that point is on the object; and whether it is on the object or below it, so that the line carries information,
        shapes (n,).
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    level, reach, depth_of_stop, in_front = limits
    first_row, end_row, first_column, end_column, stride = box
    size = max(0, (end_row - first_row + stride - 1) // stride) * max(0, (end_column - first_column + stride - 1) // stride)
    upper, lower, point = np.empty((size, 2)), np.empty((size, 2)), np.empty((size, 3), dtype=np.float32)
    stopped, informative = np.empty(size), np.empty(size, dtype=np.bool_)
    n = 0
    for row in range(first_row, end_row, stride):
        for column in range(first_column, end_column, stride):
            ray_x, ray_y, ray_z = float(rays[row, column, 0]), float(rays[row, column, 1]), float(rays[row, column, 2])
            length = (level - centre[2]) / ray_z
            if not 0.0 < length < math.inf:
                continue
            x, y = _to_object(centre[0] + ray_x * length, centre[1] + ray_y * length, pose, cos, sin)
            if not abs(_nearest(field, x, y)) < reach:
                continue
            # Height of the top beside the line: looked up where the line passes the mean level, then twice where it passes that top. Beside
            # a step of the top this does not converge; where the line passes and whether it is stopped then refer to the same height.
            top = _nearest(tops, x, y)
            for _ in range(2):
                length = (top - centre[2]) / ray_z
                x, y = _to_object(centre[0] + ray_x * length, centre[1] + ray_y * length, pose, cos, sin)
                top = _nearest(tops, x, y)
            length = (top - centre[2]) / ray_z
            upper[n, 0], upper[n, 1] = centre[0] + ray_x * length, centre[1] + ray_y * length
            threshold = max(top - depth_of_stop, 0.5 * top)
            length = (threshold - centre[2]) / ray_z
            lower[n, 0], lower[n, 1] = centre[0] + ray_x * length, centre[1] + ray_y * length
            measured = float(depth[row, column])
            if math.isfinite(measured) and left_out[row - first_row, column - first_column] != 0:
                continue
            z = centre[2] + ray_z * measured
            point[n, 0], point[n, 1], point[n, 2] = centre[0] + ray_x * measured, centre[1] + ray_y * measured, z
            stopped[n] = 1.0 if z > threshold else 0.0
            informative[n] = math.isfinite(measured) and z < top + in_front
            n += 1
    return upper[:n], lower[:n], point[:n], stopped[:n], informative[:n]


@_kernel(_GRID, _ROWS, _ROWS, _REALS, _REALS, types.UniTuple(types.float64, 3), _REALS)
def compare_lines(field: Any, upper: Any, lower: Any, stopped: Any, pose: Any, widths: Any, edges: Any) -> Any:
    """Compare the observed lines of sight with those expected at `pose`.

    Args:
        upper, lower, stopped: As in `LinesOfSight`.
        widths: Width s of the expected step; distance from the outline within which residuals estimate the noise; distance beyond which
            a line with the opposite result contradicts the pose [m].
        edges: Position of the camera, table frame, how far it displaces edges where depth jumps [m], and how well it sees walls [1/m], see
            `wall_visibility`; shape (4,).

    Returns:
        J'J, shape (3, 3), and J'r, shape (3,), with J the derivative of the expected by the pose; mean square of all residuals and of
        those at the edge (1 without any); fraction of the lines away from the edge that contradict the pose (1 without any).
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    width, at_edge, off_edge = widths
    # Sums in variables of their own: in arrays each would be written to memory and read again for every line.
    xx, xy, xt, yy, yt, tt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x_residual, y_residual, t_residual = 0.0, 0.0, 0.0
    square, square_at_edge = 0.0, 0.0
    n_at_edge, n_off_edge, n_contradicting = 0, 0, 0
    for i in range(len(upper)):
        _, _, distance, expected, by_x, by_y, by_turn = _expected(field, upper[i], lower[i], pose, cos, sin, width, edges)
        residual = stopped[i] - expected
        square += residual**2
        near, far = abs(distance) < at_edge, abs(distance) > off_edge
        n_at_edge += near
        square_at_edge += residual**2 if near else 0.0
        n_off_edge += far
        n_contradicting += far & ((distance < 0.0) != (stopped[i] > 0.5))
        x_residual += by_x * residual
        y_residual += by_y * residual
        t_residual += by_turn * residual
        xx += by_x * by_x
        xy += by_x * by_y
        xt += by_x * by_turn
        yy += by_y * by_y
        yt += by_y * by_turn
        tt += by_turn * by_turn
    normal, gradient = np.empty((3, 3)), np.empty(3)
    normal[0, 0], normal[1, 1], normal[2, 2] = xx, yy, tt
    normal[0, 1], normal[0, 2], normal[1, 2] = xy, xt, yt
    normal[1, 0], normal[2, 0], normal[2, 1] = xy, xt, yt
    gradient[0], gradient[1], gradient[2] = x_residual, y_residual, t_residual
    return (
        normal,
        gradient,
        square / max(len(upper), 1),
        square_at_edge / n_at_edge if n_at_edge else 1.0,
        n_contradicting / n_off_edge if n_off_edge else 1.0,
    )


@_kernel(_GRID, _ROWS, _ROWS, _REALS, _REALS, types.UniTuple(types.float64, 2), _REALS)
def scores_of_squares(field: Any, upper: Any, lower: Any, stopped: Any, pose: Any, widths: Any, edges: Any) -> Any:
    """The sums of `compare_lines` over squares of the object instead of over all lines of sight.

    Args:
        upper, lower, stopped: As in `LinesOfSight`.
        widths: Width s of the expected step, and edge of a square, object frame [m].
        edges: As of `compare_lines`.

    Returns:
        J'J, shape (n_squares, 3, 3), and J'r, shape (n_squares, 3), of the lines in each square, J the derivative of the expected by the
        pose; zero in squares without lines.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    width, cell = widths
    values, origin, edge = field
    rows, columns = int(values.shape[0] * edge / cell) + 1, int(values.shape[1] * edge / cell) + 1
    normal, gradient = np.zeros((rows * columns, 3, 3)), np.zeros((rows * columns, 3))
    slope = np.empty(3)
    for i in range(len(upper)):
        x, y, _, expected, slope[0], slope[1], slope[2] = _expected(field, upper[i], lower[i], pose, cos, sin, width, edges)
        u = min(max(int((x - origin[0]) / cell), 0), columns - 1)
        v = min(max(int((y - origin[1]) / cell), 0), rows - 1)
        for j in range(3):
            gradient[v * columns + u, j] += slope[j] * (stopped[i] - expected)
            for k in range(3):
                normal[v * columns + u, j, k] += slope[j] * slope[k]
    return normal, gradient


@_kernel(_GRID, _ROWS, _ROWS, _REALS, _REAL, _REALS, _read_only(types.float64, 3))
def displaced_scores(field: Any, upper: Any, lower: Any, pose: Any, width: Any, edges: Any, camera_positions: Any) -> Any:
    """J'd of a camera that displaces by one metre more every edge where depth jumps, in this image and in the outline.

    Args:
        upper, lower: As in `LinesOfSight`.
        width: Width s of the expected step [m].
        edges: As of `compare_lines`.
        camera_positions: Of the cameras that traced the outline in each rest [m], shape (n_rests, n_cameras, 2), object frame; NaN where
            a rest has fewer cameras.

    Returns:
        Shape (3,), J the derivative of the expected by the pose, d the change of the measured: 1 for edges that are displaced now, less
        the share of the rests in which they were, which is their displacement in the outline.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    camera_x = cos * (edges[0] - pose[0]) + sin * (edges[1] - pose[1])
    camera_y = -sin * (edges[0] - pose[0]) + cos * (edges[1] - pose[1])
    by_x_sum, by_y_sum, by_turn_sum = 0.0, 0.0, 0.0
    for i in range(len(upper)):
        x, y, row, column = _innermost(field, upper[i], lower[i], pose, cos, sin)
        distance, along_x, along_y = _bilinear(field, row, column)
        change = _jump(along_x * (camera_x - x) + along_y * (camera_y - y), edges[3])
        distance -= change * edges[2]
        if abs(distance) > 3.0 * width:
            continue  # its square of the steepness is 3 % of that at the edge
        for j in range(len(camera_positions)):
            least = 1.0
            for k in range(camera_positions.shape[1]):
                towards = along_x * (camera_positions[j, k, 0] - x) + along_y * (camera_positions[j, k, 1] - y)
                if not math.isnan(towards):
                    least = min(least, _jump(towards, edges[3]))
            change -= least / len(camera_positions)
        expected = 1.0 / (1.0 + math.exp(distance / width))
        steepness = expected * (1.0 - expected) / width
        by_x_sum += change * steepness**2 * (cos * along_x - sin * along_y)
        by_y_sum += change * steepness**2 * (sin * along_x + cos * along_y)
        by_turn_sum -= change * steepness**2 * (along_x * y - along_y * x)
    scores = np.empty(3)
    scores[0], scores[1], scores[2] = by_x_sum, by_y_sum, by_turn_sum
    return scores


@_kernel(_IMAGE, _POINTS, _REALS)
def place_points(depth: Any, rays: Any, centre: Any) -> Any:
    """centre + depth * ray of each pixel, shape (height, width, 3), single precision."""
    x, y, z = np.float32(centre[0]), np.float32(centre[1]), np.float32(centre[2])
    points = np.empty(rays.shape, dtype=np.float32)
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            measured = depth[row, column]
            points[row, column, 0] = rays[row, column, 0] * measured + x
            points[row, column, 1] = rays[row, column, 1] * measured + y
            points[row, column, 2] = rays[row, column, 2] * measured + z
    return points


@_kernel(_POINTS, _IMAGE, types.UniTuple(_REAL, 4), types.UniTuple(_REAL, 4), types.UniTuple(types.int64, 4))
def label_heights(points: Any, smooth: Any, workspace: Any, heights: Any, codes: Any) -> Any:
    """Label every pixel by its height.

    Args:
        points: Shape (height, width, 3); not finite where notarget was measured.
        smooth: Heights without outliers, shape (height, width).
        workspace: Smallest and largest x, smallest and largest y.
        heights: Lowest height of the table, of anything raised, of objects, and of the robot [m].
        codes: For unknown, table, object and robot.

    Returns:
        The codes, and which pixels show something raised that is not above every object, shapes (height, width).
    """
    low_x, high_x, low_y, high_y = workspace
    lowest, least_raised, least_object, least_robot = heights
    unknown, table, target, robot = codes
    labels, raised = np.empty(smooth.shape, dtype=np.int8), np.zeros(smooth.shape, dtype=np.bool_)
    for v in range(smooth.shape[0]):
        for u in range(smooth.shape[1]):
            x, y, z, height = points[v, u, 0], points[v, u, 1], points[v, u, 2], smooth[v, u]
            if not math.isfinite(z):
                labels[v, u] = unknown
            elif height > least_robot:
                labels[v, u] = robot
            else:
                raised[v, u] = height > least_raised
                if height > least_object and low_x <= x <= high_x and low_y <= y <= high_y:
                    labels[v, u] = target
                else:
                    labels[v, u] = table if z > lowest else unknown
    return labels, raised


@_kernel(_read_only(types.float32, 2), _ROWS, _REAL)
def points_in_rods(points: Any, rods: Any, margin: Any) -> Any:
    """Which points (n, 3) lie in a rod grown by `margin` [m]; each rod is a row of start, unit direction, length and radius."""
    inside = np.zeros(len(points), dtype=np.bool_)
    for i in range(len(points)):
        for k in range(len(rods)):
            rod = rods[k]
            x, y, z = points[i, 0] - rod[0], points[i, 1] - rod[1], points[i, 2] - rod[2]
            along = x * rod[3] + y * rod[4] + z * rod[5]
            if -margin < along < rod[6] + margin and x * x + y * y + z * z - along * along < (rod[7] + margin) ** 2:
                inside[i] = True
                break
    return inside


@_kernel(_POINTS, _read_only(types.int8, 2), types.int64, types.int64, _REALS, _REAL, types.int64, types.int64)
def project_down(points: Any, labels: Any, table: Any, target: Any, low: Any, size: Any, rows: Any, columns: Any) -> Any:
    """Project labelled points onto cells of edge `size` [m], the first of which has its low corner at `low`.

    Returns:
        Which cells hold points labelled `table`, and which `target`; and per cell the height of the highest target point, else of the
        table, -infinity in cells without points [m]. Shapes (rows, columns).
    """
    has_table, has_target = np.zeros((rows, columns), dtype=np.bool_), np.zeros((rows, columns), dtype=np.bool_)
    height = np.full((rows, columns), np.float32(-np.inf))
    edge = np.float32(size)
    low_x, low_y = np.float32(low[0]), np.float32(low[1])
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            label = labels[v, u]
            if label != table and label != target:
                continue
            row, column = (points[v, u, 1] - low_y) / edge, (points[v, u, 0] - low_x) / edge
            if not (0.0 <= row < rows and 0.0 <= column < columns):
                continue
            i, j = int(row), int(column)
            if label == target:
                height[i, j] = max(height[i, j], points[v, u, 2]) if has_target[i, j] else points[v, u, 2]
                has_target[i, j] = True
            else:
                # The table has one height: any of its points will do.
                if not has_target[i, j]:
                    height[i, j] = points[v, u, 2]
                has_table[i, j] = True
    return has_table, has_target, height


@_kernel(_ROWS, _ROWS)
def outline_distances(points: Any, outline: Any) -> Any:
    """`geometry.outline.signed_distance`, compiled: the same operations in the same order, so equal to the last bit.

    Args:
        points: Shape (n, 2) [m].
        outline: Shape (n_vertices, 2) [m].
    """
    n = len(outline)
    edge, square = np.empty((n, 2)), np.empty(n)
    for k in range(n):
        end = k + 1 if k + 1 < n else 0
        edge[k, 0], edge[k, 1] = outline[end, 0] - outline[k, 0], outline[end, 1] - outline[k, 1]
        square[k] = max(edge[k, 0] * edge[k, 0] + edge[k, 1] * edge[k, 1], 1e-300)
    result = np.empty(len(points))
    for i in range(len(points)):
        px, py = points[i, 0], points[i, 1]
        nearest2, inside = math.inf, False
        above = outline[0, 1] > py
        for k in range(n):
            ex, ey = edge[k, 0], edge[k, 1]
            x, y = px - outline[k, 0], py - outline[k, 1]
            along = min(max((x * ex + y * ey) / square[k], 0.0), 1.0)
            off_x, off_y = x - along * ex, y - along * ey
            distance2 = off_x * off_x + off_y * off_y
            if not distance2 >= nearest2:  # so that NaN stays NaN
                nearest2 = distance2
            end = k + 1 if k + 1 < n else 0
            end_above = outline[end, 1] > py
            if above != end_above and px < outline[k, 0] + y * ex / ey:
                inside = not inside
            above = end_above
        result[i] = -math.sqrt(nearest2) if inside else math.sqrt(nearest2)
    return result


@_kernel(_ROWS, _ROWS)
def edges_nearest(points: Any, outline: Any) -> Any:
    """Index of the edge nearest to each point (n, 2), of several the first; and how far along that edge, or beyond it, the point lies [m].

    Shapes (n,). `outline` has shape (n_vertices, 2).
    """
    n = len(outline)
    edge, direction, length = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    for k in range(n):
        end = k + 1 if k + 1 < n else 0
        edge[k, 0], edge[k, 1] = outline[end, 0] - outline[k, 0], outline[end, 1] - outline[k, 1]
        length[k] = math.sqrt(edge[k, 0] * edge[k, 0] + edge[k, 1] * edge[k, 1])
        direction[k, 0], direction[k, 1] = edge[k, 0] / length[k], edge[k, 1] / length[k]
    index, position = np.zeros(len(points), dtype=np.int64), np.zeros(len(points))
    for i in range(len(points)):
        nearest, nearest2 = math.inf, math.inf
        for k in range(n):
            x, y = points[i, 0] - outline[k, 0], points[i, 1] - outline[k, 1]
            along = (x * edge[k, 0] + y * edge[k, 1]) / length[k]
            foot = min(max(along, 0.0), length[k])
            off_x, off_y = x - foot * direction[k, 0], y - foot * direction[k, 1]
            distance2 = off_x * off_x + off_y * off_y
            # Two edges that share the nearest corner may differ in the last bit of the square: the first one counts.
            if distance2 < nearest2 and math.sqrt(distance2) < nearest:
                nearest, nearest2 = math.sqrt(distance2), distance2
                index[i], position[i] = k, along
    return index, position


@_kernel(types.Array(types.float32, 2, "C"))
def sort_columns(values: Any) -> Any:
    """Sort each column of `values`, shape (n, m), in place, ascending; NaN is not allowed.

    A network of compare-and-swap of whole rows (odd-even transposition), which the compiler turns into vector instructions.
    """
    n, m = values.shape
    for turn in range(n):
        for row in range(turn % 2, n - 1, 2):
            for column in range(m):
                a, b = values[row, column], values[row + 1, column]
                values[row, column], values[row + 1, column] = (a if a < b else b), (b if a < b else a)


@_kernel(_DEPTH, _FLAGS, _REAL)
def mark_jumps(depth: Any, mask: Any, step: Any) -> Any:
    """Pixels of the mask whose depth differs by more than `step` [m] from a pixel of it one or two pixels away, straight or diagonally.

    `depth` [m] and `mask` have shape (height, width), as has the result.
    """
    height, width = mask.shape
    threshold = np.float32(step)
    cut = np.zeros(mask.shape, dtype=np.bool_)
    for v in range(height):
        for u in range(width):
            if not mask[v, u]:
                continue
            for lag in (1, 2):
                for rows, columns in ((0, lag), (lag, 0), (lag, lag), (lag, -lag)):
                    i, j = v + rows, u + columns
                    if i < height and 0 <= j < width and mask[i, j] and abs(depth[i, j] - depth[v, u]) > threshold:
                        cut[v, u] = cut[i, j] = True
    return cut


@_kernel(_DEPTH, _NUMBERS, types.UniTuple(types.UniTuple(types.int64, 2), 4), _REAL)
def mark_folds(inverse: Any, patches: Any, legs: Any, sag: Any) -> Any:
    """Pixels deeper than a chord by more than `sag` [m], whose two ends are on the same patch as the pixel.

    Args:
        inverse: Inverse depth [1/m], shape (height, width).
        patches: Number of the patch of each pixel, 0 for none, same shape.
        legs: From the middle to the end of each chord: rows, which are not negative, and columns.
    """
    height, width = patches.shape
    least, one, two = np.float32(sag), np.float32(1.0), np.float32(2.0)
    folded = np.zeros(patches.shape, dtype=np.bool_)
    for v in range(height):
        for u in range(width):
            number = patches[v, u]
            if number == 0:
                continue
            for rows, columns in legs:
                top, left, bottom, right = v - rows, u - columns, v + rows, u + columns
                if top < 0 or bottom >= height or min(left, right) < 0 or max(left, right) >= width:
                    continue
                if patches[top, left] == number and patches[bottom, right] == number:
                    chord = two / (inverse[top, left] + inverse[bottom, right])
                    if one / inverse[v, u] - chord > least:
                        folded[v, u] = True
                        break
    return folded


@_kernel(_NUMBERS, _DEPTH, _FLAGS, _REAL)
def grow_surfaces(surfaces: Any, depth: Any, mask: Any, step: Any) -> Any:
    """Grow numbered surfaces over the pixels of `mask`, one ring of pixels at a time.

    Each pixel joins, of its four neighbours that belong to a surface, the one nearest in depth, if the difference is below `step` [m]. A
    pixel that could not join is looked at again only when another neighbour has joined. All arrays have shape (height, width).
    """
    height, width = mask.shape
    threshold = np.float32(step)
    grown, looked_at = surfaces.copy(), np.zeros(mask.shape, dtype=np.int32)
    border, following = np.empty(mask.size, dtype=np.int64), np.empty(mask.size, dtype=np.int64)
    joined = np.empty(mask.size, dtype=np.int32)
    n, turn = 0, 1
    for v in range(height):
        for u in range(width):
            if mask[v, u] and grown[v, u] == 0:
                border[n] = v * width + u
                n += 1
    while n > 0:
        for k in range(n):
            v, u = border[k] // width, border[k] % width
            best, joined[k] = threshold, 0
            for rows, columns in ((0, -1), (0, 1), (-1, 0), (1, 0)):
                i, j = v + rows, u + columns
                if 0 <= i < height and 0 <= j < width and grown[i, j] > 0:
                    difference = abs(depth[i, j] - depth[v, u])
                    if difference < best:
                        best, joined[k] = difference, grown[i, j]
        for k in range(n):
            if joined[k] > 0:
                grown[border[k] // width, border[k] % width] = joined[k]
        n_following = 0
        for k in range(n):
            if joined[k] == 0:
                continue
            v, u = border[k] // width, border[k] % width
            for rows, columns in ((0, -1), (0, 1), (-1, 0), (1, 0)):
                i, j = v + rows, u + columns
                if 0 <= i < height and 0 <= j < width and mask[i, j] and grown[i, j] == 0 and looked_at[i, j] != turn:
                    looked_at[i, j] = turn
                    following[n_following] = i * width + j
                    n_following += 1
        border, following = following, border
        n, turn = n_following, turn + 1
    return grown
