"""The smallest box around a mesh, and its shadow on the table, to the same bit on every CPU.

The search is that of trimesh 4, with which the official scenes were made: one direction after the
other is tried among the normals of the convex hull, and the box of least volume wins. For a cube
all candidates have the same volume but for rounding, so the last bit decides which axes come first.
Hull and adjacency are trimesh's and Qhull's. What trimesh leaves to BLAS and to NumPy's vectorised
inverse functions is computed here.
"""

import math
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull
from trimesh import Trimesh, grouping, util

from mme_vla.envs.robomme.scene.arithmetic import matrix_product

VERTICAL = 1e-6
"""An axis whose part on the table is shorter than this stands upright."""
_SHORTEST_EDGE = 1e-10
_SMALLEST_COMPONENT = 1e-8
"""Of a direction; a smaller one counts as zero."""


@lru_cache(maxsize=256)
def shadow_of_smallest_box(
    vertices: bytes, faces: bytes
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the first two axes of a mesh's smallest box cover on the table.

    Cached, since an object is an obstacle for all that are placed after it.

    Args:
        vertices: [n, 3], float64 in bytes, metres.
        faces: [m, 3], int64 in bytes.

    Returns:
        Centre [2], the two axes [2, 2], one a row, of length one or, where upright, zero, and half
        the widths [2].
    """
    points = np.frombuffer(vertices).reshape(-1, 3)
    triangles = np.frombuffer(faces, np.int64).reshape(-1, 3)
    rotation, widths = smallest_box(Trimesh(points, triangles, process=False))
    corners = matrix_product(rotation, points.T)
    middle = corners.min(axis=1) + np.ptp(corners, axis=1) * 0.5
    centre = matrix_product(rotation.T, middle[:, None])[:2, 0]
    axes = rotation[:2, :2]
    lengths = np.sqrt(axes[:, :1] * axes[:, :1] + axes[:, 1:] * axes[:, 1:])
    axes = np.where(lengths > VERTICAL, axes / np.maximum(lengths, VERTICAL), 0.0)
    return centre, axes, widths[:2] / 2


def smallest_box(mesh: Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Axes of the box of least volume around a mesh, in order of its widths.

    Returns:
        A rotation or reflection [3, 3], one axis a row, and the widths along them [3], metres.
    """
    hull = mesh.convex_hull
    vertices = np.asarray(hull.vertices, np.float64)
    normals = np.asarray(hull.face_normals, np.float64)
    least = math.inf
    upright = np.eye(3)
    for azimuth, inclination in _directions(normals):
        # The rotation that turns the direction upright.
        cos_a, sin_a = math.cos(azimuth), math.sin(azimuth)
        cos_i, sin_i = math.cos(inclination), math.sin(inclination)
        turn = np.array([
            [cos_i * cos_a, cos_i * sin_a, -sin_i],
            [-sin_a, cos_a, 0.0],
            [sin_i * cos_a, sin_i * sin_a, cos_i],
        ])  # fmt: skip
        up = turn[2]
        heights = normals[:, 0] * up[0] + normals[:, 1] * up[1] + normals[:, 2] * up[2]
        visible = heights > -_SHORTEST_EDGE
        if not visible.any():
            continue
        # The outline seen from this direction: edges of which one face is visible and the other is
        # not.
        first, second = visible[hull.face_adjacency.T]
        outline = hull.face_adjacency_edges[first != second]
        turned = matrix_product(turn, vertices.T).T
        ends = turned[:, :2][outline]
        widths = _widths_along(_unit_edges(ends), ends[:, 0])
        volume = (widths[:, 0] * widths[:, 1]).min() * np.ptp(turned[:, 2])
        if volume < least:
            least, upright = volume, turn
    turned = matrix_product(upright, vertices.T).T
    rotation, rectangle = _smallest_rectangle(turned[:, :2])
    widths = np.append(rectangle, np.ptp(turned[:, 2]))
    order = widths.argsort()
    return matrix_product(rotation, upright)[order], widths[order]


def _directions(normals: np.ndarray) -> np.ndarray:
    """Azimuth and inclination [n, 2] of the normals that differ by a tenth of a radian, taken to
    the upper half.
    """
    upper = util.vector_hemisphere(normals)
    lengths = np.sqrt(
        upper[:, 0] * upper[:, 0] + upper[:, 1] * upper[:, 1] + upper[:, 2] * upper[:, 2]
    )
    units = upper * (1.0 / lengths)[:, None]
    units[np.abs(units) < _SMALLEST_COMPONENT] = 0.0
    angles = np.array([(math.atan2(y, x), math.acos(min(1.0, z))) for x, y, z in units])
    return angles[grouping.unique_rows(angles, digits=1)[0]]


def _unit_edges(ends: np.ndarray) -> np.ndarray:
    """Directions [m, 2] of edges given by their ends [n, 2, 2]; edges without length
    are left out.
    """
    edges = ends[:, 1] - ends[:, 0]
    lengths = np.sqrt(edges[:, 0] * edges[:, 0] + edges[:, 1] * edges[:, 1])
    long_enough = lengths > _SHORTEST_EDGE
    return edges[long_enough] / lengths[long_enough, None]


def _widths_along(edges: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Widths [m, 2] of points [n, 2] along each of the directions [m, 2] and across it."""
    across = np.column_stack((-edges[:, 1], edges[:, 0]))
    lengths = np.ptp(matrix_product(edges, points.T), axis=1)
    widths = np.ptp(matrix_product(across, points.T), axis=1)
    return np.column_stack([lengths, widths])


def _smallest_rectangle(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation [3, 3] about the vertical that lays the longer side of the smallest rectangle
    along x.

    Args:
        points: [n, 2].

    Returns:
        The rotation, and the rectangle's sides, the longer one first [2].
    """
    hull = ConvexHull(points, qhull_options="QbB")
    edges = _unit_edges(hull.points[hull.simplices])
    widths = _widths_along(edges, hull.points[hull.vertices])
    best = (widths[:, 0] * widths[:, 1]).argmin()
    sides = widths[best]
    rotation = _about_vertical(math.atan2(edges[best, 1], edges[best, 0]))
    if sides[1] > sides[0]:
        rotation, sides = matrix_product(_about_vertical(math.pi / 2), rotation), sides[::-1]
    return rotation, sides


def _about_vertical(angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
