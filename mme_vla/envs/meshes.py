"""Meshes with no more detail than a picture can show.

The stock wrist camera is drawn as it was constructed, screws and circuit boards included: 425,160 triangles of some
0.03 mm, three quarters of the scene, where a pixel covers more than a millimetre. Corners that lie in the same cell of
a grid become one, and what has no area then is left out; every other mesh of the robots is coarser than that already.
"""

from pathlib import Path

import numpy as np

CELL = 0.001
"""Width of a cell, metres: less than a pixel covers from 0.13 metres on."""
_HEADER_BYTES = 80
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def coarsen(corners: np.ndarray, cell: float = CELL) -> np.ndarray:
    """Merge corners that lie in one cell of a grid into their mean.

    Args:
        corners: of each triangle, float [n, 3, 3], metres.
        cell: width of a cell, metres.

    Returns:
        Corners [m, 3, 3] float32, m <= n, of the triangles whose corners lie in three cells, each once and with its
        side kept, in an order that depends on nothing else.
    """
    points = corners.reshape(-1, 3)
    _, cells, counts = np.unique(
        np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    cells = cells.reshape(-1)
    means = np.stack([np.bincount(cells, points[:, axis]) for axis in range(3)], 1) / counts[:, None]
    triangles = cells.reshape(-1, 3)
    different = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    triangles = triangles[different]
    # Turned, so that a triangle begins with its lowest corner whichever it began with.
    turns = (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3
    triangles = np.unique(np.take_along_axis(triangles, turns, axis=1), axis=0)
    return means[triangles].astype(np.float32)


def read_stl(path: Path) -> np.ndarray:
    """Corners [n, 3, 3] float32 of the triangles of a binary STL file."""
    return np.frombuffer(path.read_bytes(), _TRIANGLE, offset=_HEADER_BYTES + 4)["corners"].copy()


def stl_bytes(corners: np.ndarray) -> bytes:
    """A binary STL file of triangles with corners [n, 3, 3], each with the normal of its side."""
    triangles = np.zeros(len(corners), _TRIANGLE)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    triangles["corners"] = corners
    return bytes(_HEADER_BYTES) + len(corners).to_bytes(4, "little") + triangles.tobytes()
