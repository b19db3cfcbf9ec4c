"""Visibility: which face each cell of the image shows, for one camera pose.

For a face with normal n at the signed distance d = n . (o - c) from the camera, the inverse range along a unit ray
r is (n . r)/d: linear in the ray, and largest for the face in front. Texture coordinates are u = (M0 . r)/(M2 . r)
and v = (M1 . r)/(M2 . r), where M2 . r is the inverse range, so one 3 x 3 matrix per face is sufficient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core.camera import Camera
from perch_sim.rendering.grid import CellGrid
from perch_sim.rendering.kernels import classify
from perch_sim.rendering.scene import Face

EDGE_SAMPLES = 128  # points per edge by which the cells are found that an edge crosses
MIN_DISTANCE = 1e-3  # a camera closer to a face's plane than this sees nothing of it [m]


@dataclass(frozen=True, eq=False)
class FaceArrays:
    """The faces of a scene as arrays, one row per face.

    Attributes:
        centre_W, right_W, up_W, normal_W: shape (n, 3).
        half: half extents, shape (n, 2) [m]; infinite where the face is not bounded.
        texel: [m], shape (n,).
        moving, fine: bool, shape (n,): moves with the target; rendered with several samples per pixel.
        bounded, room: indices of the faces with edges, shape (m,); indices of the others.
        row: index of each face in `bounded`, -1 for those without edges, shape (n,).
        edges_W: points on the edges of the bounded faces, shape (m, 4 * EDGE_SAMPLES, 3).
    """

    centre_W: np.ndarray
    right_W: np.ndarray
    up_W: np.ndarray
    normal_W: np.ndarray
    half: np.ndarray
    texel: np.ndarray
    moving: np.ndarray
    fine: np.ndarray
    bounded: np.ndarray
    room: np.ndarray
    row: np.ndarray
    edges_W: np.ndarray

    @classmethod
    def of(cls, faces: tuple[Face, ...]) -> FaceArrays:
        """Return the arrays of the faces of a scene."""
        bounded = [i for i, face in enumerate(faces) if face.bounded]
        edges = [_edge_points(faces[i]) for i in bounded]
        row = np.full(len(faces), -1)
        row[bounded] = np.arange(len(bounded))
        return cls(
            np.array([f.centre_W for f in faces]), np.array([f.right_W for f in faces]),
            np.array([f.up_W for f in faces]), np.array([f.normal_W for f in faces]),
            np.array([f.half if f.bounded else (np.inf, np.inf) for f in faces]),
            np.array([f.texel for f in faces]), np.array([f.moving for f in faces]),
            np.array([f.kind == "pad" for f in faces]), np.array(bounded, dtype=int), np.flatnonzero(row < 0), row,
            np.array(edges).reshape(len(bounded), 4 * EDGE_SAMPLES, 3),
        )


def _edge_points(face: Face) -> np.ndarray:
    t = np.linspace(-1.0, 1.0, EDGE_SAMPLES)
    one = np.ones_like(t)
    uv = np.concatenate([np.stack(pair, -1) for pair in ((t, one), (t, -one), (one, t), (-one, t))])
    return face.centre_W + uv[:, :1] * face.half[0] * face.right_W + uv[:, 1:] * face.half[1] * face.up_W


@dataclass(frozen=True, eq=False)
class View:
    """Faces of a scene as seen from one camera pose.

    Attributes:
        M: ray in C -> (u/range, v/range, 1/range), float32, shape (n, 3, 3); zero for faces that face away.
        distance: distance of the camera from each face's plane [m], shape (n,).
        front: whether a face is turned towards the camera, shape (n,) bool.
        first: face that each cell shows at its first corner (-1: none), shape (cells,).
        uniform: whether the cell shows that face alone, shape (cells,) bool.
        shown: for each bounded face, the cells that one of its edges crosses or in which a corner's ray hits it, shape
            (m, cells) bool.
    """

    M: np.ndarray
    distance: np.ndarray
    front: np.ndarray
    first: np.ndarray
    uniform: np.ndarray
    shown: np.ndarray


def face_matrices(faces: FaceArrays, p_WC: np.ndarray, R_WC: np.ndarray,
                  shift_W: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return M (n, 3, 3), distances (n,) [m] and the mask of faces turned towards the camera: see `View`."""
    offset = p_WC - faces.centre_W - faces.moving[:, None] * shift_W  # from the face's centre to the camera
    distance = np.sum(faces.normal_W * offset, axis=1)
    front = distance > MIN_DISTANCE
    inverse = -(faces.normal_W @ R_WC) / np.where(front, distance, 1.0)[:, None]
    M = np.empty((len(distance), 3, 3))
    M[:, 0] = np.sum(faces.right_W * offset, axis=1)[:, None] * inverse + faces.right_W @ R_WC
    M[:, 1] = np.sum(faces.up_W * offset, axis=1)[:, None] * inverse + faces.up_W @ R_WC
    M[:, 2] = inverse
    M[~front] = 0.0
    return M.astype(np.float32), distance, front


def classify_view(faces: FaceArrays, grid: CellGrid, camera: Camera, p_WC: np.ndarray, R_WC: np.ndarray,
         shift_W: np.ndarray) -> View:
    """Return the face that each cell shows, and the cells that edges of faces cross.

    Args:
        faces: faces of the scene.
        grid, camera: cells of the image and their camera.
        p_WC, R_WC: pose of the camera in W [m].
        shift_W: displacement of the moving faces [m], shape (3,).
    """
    M, distance, front = face_matrices(faces, p_WC, R_WC, shift_W)
    shown = _crossings(faces, grid, camera, p_WC, R_WC, shift_W, front)
    cells = shown.shape[1]
    view = View(M, distance, front, np.empty(cells, np.int64), np.empty(cells, bool), shown)
    classify(M, faces.half.astype(np.float32), faces.row, grid.nodes, grid.corner_nodes, view.first, view.uniform, shown)
    return view


def _crossings(faces: FaceArrays, grid: CellGrid, camera: Camera, p_WC: np.ndarray, R_WC: np.ndarray,
               shift_W: np.ndarray, front: np.ndarray) -> np.ndarray:
    crossed = np.zeros((len(faces.bounded), grid.rows * grid.cols), dtype=bool)
    rows = np.flatnonzero(front[faces.bounded])
    moved = faces.moving[faces.bounded[rows], None, None] * shift_W
    points_C = (faces.edges_W[rows] + moved - p_WC) @ R_WC
    cells = grid.cell_of(camera.project(points_C.reshape(-1, 3))[0]).reshape(points_C.shape[:2])
    for row, touched in zip(rows, cells):
        crossed[row, touched[touched >= 0]] = True
    return crossed
