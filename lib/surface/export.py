"""Surfaces for other programs: textured meshes (GLB), point clouds (PLY), depth maps (TIFF).  No file is left incomplete.

Open3D writes meshes and point clouds.  Only this module imports it, and only when needed, since it needs system libraries.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lib.files import whole, write_bytes
from lib.geometry import finite_points
from lib.surface.bspline import BSplineSurface


def open3d() -> ModuleType:
    """The module open3d; if its system libraries are missing, an ImportError says in one line what to install."""
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # in JupyterLab that prints lines and hangs
    try:
        import open3d
    except (ImportError, OSError) as error:
        cure = "On Debian and Ubuntu: apt-get install libegl1 libgl1 libusb-1.0-0"
        raise ImportError(f"Open3D does not load ({error}). {cure}") from error
    return open3d


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface as triangles.

    `vertices_mm` (n, 3) have unit `normals` (n, 3) towards the camera; `faces` (m, 3) int32 are counter-clockwise as the
    camera sees them; `u` (n, 2) px are texture coordinates in the left image, `texture` (h, w, 3) uint8 RGB or None.
    """

    vertices_mm: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    u: np.ndarray
    texture: np.ndarray | None = None


def surface_mesh(
    surface: BSplineSurface, *, step_px: float = 12.0, image: np.ndarray | None = None, mask: np.ndarray | None = None
) -> Mesh:
    """A mesh of the surface over its domain.

    Args:
        step_px: Largest distance of neighbouring vertices in the left image.
        image: (h, w, 3) uint8 RGB left image for the texture.
        mask: (h, w) bool of the left image, True where the surface is shown; None is everywhere.  Not all may be hidden.
    """
    if not step_px > 0:
        raise ValueError(f"step_px: must be positive, got {step_px}.")
    if mask is not None:
        fits = mask.ndim == 2 and (np.array(mask.shape[::-1]) - 0.5 >= surface.grid.domain[2:]).all()
        if not fits or (image is not None and mask.shape != image.shape[:2]):
            raise ValueError(f"mask: expected (h, w) of the left image, which holds the surface's domain, got {mask.shape}.")
    ends = np.reshape(surface.grid.domain, (2, 2)).T
    x, y = (np.linspace(low, high, int(np.ceil((high - low) / step_px)) + 1) for low, high in ends)
    u = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    corner = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    right, below = corner + 1, corner + len(x)
    faces = np.concatenate([np.stack([corner, below, right], axis=1), np.stack([right, below, below + 1], axis=1)])
    if mask is not None:
        column, row = np.clip(np.rint(u), 0, (mask.shape[1] - 1, mask.shape[0] - 1)).astype(int).T
        faces = faces[np.asarray(mask, dtype=bool)[row, column][faces].all(axis=1)]
        if not len(faces):
            raise ValueError("mask: it hides the whole surface; True marks the parts to show.")
        kept, faces = np.unique(faces, return_inverse=True)
        u, faces = u[kept], faces.reshape(-1, 3)
    return Mesh(surface(u), surface.normal(u), faces.astype(np.int32), u, image)


def save_mesh(mesh: Mesh, path: str | Path) -> Path:
    """Write a mesh as binary glTF (.glb) with its texture inside, in metres, the unit of glTF.

    An ImportError says that Open3D does not load, an OSError that it cannot write the file.
    """
    path = _suffixed(path, ".glb")
    o3d = open3d()

    def tensor(values: np.ndarray) -> object:
        return o3d.core.Tensor(np.ascontiguousarray(values))

    written = o3d.t.geometry.TriangleMesh(tensor(mesh.vertices_mm.astype(np.float32) / 1000), tensor(mesh.faces))
    written.vertex.normals = tensor(mesh.normals.astype(np.float32))
    if mesh.texture is not None:
        # Open3D's texture coordinates start at the lower left corner; pixel centres are half a pixel from it.
        uv = (mesh.u + 0.5) / mesh.texture.shape[1::-1] * (1, -1) + (0, 1)
        written.triangle.texture_uvs = tensor(uv[mesh.faces].astype(np.float32))
        written.material.set_default_properties()
        written.material.material_name = "defaultLit"
        written.material.texture_maps["albedo"] = o3d.t.geometry.Image(tensor(mesh.texture))
    # The header of a GLB contains the length of the file.
    _write(path, lambda name: o3d.t.io.write_triangle_mesh(name, written),
           lambda data: len(data) > 12 and int.from_bytes(data[8:12], "little") == len(data))  # fmt: skip
    return path


def save_points(path: str | Path, x_mm: ArrayLike, *, colours: np.ndarray | None = None) -> Path:
    """Write points (n, 3) mm as a binary PLY, with colours (n, 3) uint8 RGB where given; errors as for `save_mesh`."""
    path = _suffixed(path, ".ply")
    x = finite_points(x_mm, 3, "x_mm")
    if colours is not None and np.shape(colours) != x.shape:
        raise ValueError(f"colours: expected one row a point, {x.shape}, got {np.shape(colours)}.")
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(x))
    if colours is not None:
        cloud.colors = o3d.utility.Vector3dVector(np.asarray(colours, dtype=np.float64) / 255)
    _write(path, lambda name: o3d.io.write_point_cloud(name, cloud), lambda data: len(data) >= x.nbytes)
    return path


def save_map(path: str | Path, values_mm: np.ndarray) -> Path:
    """Write depths (h, w) or positions x, y, z (h, w, 3) as a 32-bit float TIFF in mm (NaN = no surface)."""
    path, values_mm = _suffixed(path, ".tiff", ".tif"), np.asarray(values_mm, dtype=np.float32)
    if values_mm.ndim != 2 and values_mm.shape[2:] != (3,):
        raise ValueError(f"values_mm: expected (h, w) or (h, w, 3), got shape {values_mm.shape}.")
    stored = values_mm if values_mm.ndim == 2 else values_mm[:, :, ::-1]  # OpenCV exchanges the first and the last channel
    write_bytes(path, cv2.imencode(".tiff", stored)[1].tobytes())
    return path


def _write(path: Path, write: Callable[[str], bool], is_whole: Callable[[bytes], bool]) -> None:
    """Write a file with one of Open3D's writers.  These return False if they fail, but some return True on a full disk."""
    with whole(path) as partial:
        if not write(str(partial)) or not is_whole(partial.read_bytes()):
            raise OSError(f"{path}: Open3D could not write the whole file; is the disk full?")


def _suffixed(path: str | Path, *suffixes: str) -> Path:
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"path: {path.name} should end in {' or '.join(suffixes)}.")
    return path
