"""Meshes, point clouds and depth maps: written, read back by another program, whole or not at all."""

from __future__ import annotations

import json
import struct

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from lib.surface import (
    depth_map,
    fit_surface,
    remove_outliers,
    save_depth_map,
    save_mesh,
    save_points,
    surface_mesh,
)

o3d = pytest.importorskip("open3d", exc_type=(ImportError, OSError), reason="Open3D's system libraries are missing")


@pytest.fixture(scope="module")
def surface(bowl):
    return fit_surface(bowl.u_left, bowl.points.x_mm, domain=bowl.domain, smoothness=1e4, camera=bowl.rig.left)


@pytest.fixture(scope="module")
def image():
    columns, rows = np.meshgrid(np.arange(1920), np.arange(1080))
    return np.stack([columns % 256, rows % 256, np.full_like(rows, 90)], axis=-1).astype(np.uint8)


def test_mesh_lies_on_the_surface_and_faces_the_camera(surface, image, bowl):
    mesh = surface_mesh(surface, step_px=40, image=image)
    np.testing.assert_allclose(mesh.vertices_mm, surface(mesh.u))
    corners = mesh.vertices_mm[mesh.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ bowl.rig.left.viewing_direction
    assert (facing < 0).all() and (mesh.normals @ bowl.rig.left.viewing_direction < 0).all()
    area_px2 = np.ptp(surface.grid.domain[::2]) * np.ptp(surface.grid.domain[1::2])
    u = mesh.u[mesh.faces]
    edge, other = u[:, 1] - u[:, 0], u[:, 2] - u[:, 0]
    covered = np.abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]).sum() / 2
    assert covered == pytest.approx(area_px2)
    nearest = np.rint(mesh.u).astype(int)
    np.testing.assert_array_equal(mesh.colours, image[nearest[:, 1], nearest[:, 0]])


def test_mask_hides_triangles(surface):
    mask = np.zeros((1080, 1920), dtype=bool)
    mask[:, :960] = True
    mesh = surface_mesh(surface, step_px=40, mask=mask)
    assert mesh.u[:, 0].max() < 960 and mesh.faces.max() == len(mesh.u) - 1
    with pytest.raises(ValueError, match="mask"):
        surface_mesh(surface, mask=np.zeros_like(mask))


@pytest.mark.parametrize("textured", [True, False])
def test_glb_is_read_by_open3d(surface, image, tmp_path, textured):
    mesh = surface_mesh(surface, step_px=60, image=image if textured else None)
    path = save_mesh(mesh, tmp_path / "eye.glb")
    assert [p.name for p in tmp_path.iterdir()] == ["eye.glb"]
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    document = json.loads(content[20 : 20 + struct.unpack_from("<I", content, 12)[0]])
    assert ("images" in document) == textured
    read = o3d.io.read_triangle_mesh(str(path))
    # Open3D sorts vertices and faces its own way, and turns v upside down: compare each face's corners.
    theirs = np.asarray(read.vertices)[np.asarray(read.triangles)].reshape(-1, 9) * 1000
    ours = mesh.vertices_mm[mesh.faces].reshape(-1, 9)
    assert len(ours) == len(theirs)
    distance, index = KDTree(theirs).query(ours)
    assert distance.max() < 1e-3 and len(np.unique(index)) == len(ours)
    if textured:
        uv = np.abs(np.asarray(read.triangle_uvs).reshape(-1, 3, 2) - [0, 1])[index]
        np.testing.assert_allclose(uv, ((mesh.u + 0.5) / (1920, 1080))[mesh.faces], atol=1e-5)


def test_ply_comes_back_with_colours_and_normals(surface, image, bowl, tmp_path):
    mesh = surface_mesh(surface, step_px=80, image=image)
    path = save_points(tmp_path / "cloud.ply", mesh.vertices_mm, colours=mesh.colours, normals=mesh.normals)
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.ply"]
    cloud = o3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(cloud.points), mesh.vertices_mm, atol=1e-6)
    np.testing.assert_array_equal(np.rint(np.asarray(cloud.colors) * 255), mesh.colours)
    np.testing.assert_allclose(np.asarray(cloud.normals), mesh.normals, atol=1e-6)


def test_depth_map_is_the_surface_along_the_view(surface, bowl, tmp_path):
    depth = depth_map(surface, bowl.rig.left, (1920, 1080))
    assert depth.shape == (1080, 1920) and np.isnan(depth[0, 0])
    x = surface([[700.0, 400.0]])[0]
    assert depth[400, 700] == pytest.approx(x @ bowl.rig.left.viewing_direction, abs=1e-5)
    path = save_depth_map(tmp_path / "depth.tiff", depth)
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), depth)


def test_statistical_outlier_removal_drops_lone_points(bowl):
    x = bowl.points.x_mm[~bowl.outlier]
    lone = x[:5] - 3 * bowl.rig.left.viewing_direction
    kept = remove_outliers(np.vstack([x, lone]))
    assert not kept[-5:].any() and kept[:-5].mean() > 0.9
    with pytest.raises(ValueError, match="neighbours"):
        remove_outliers(x[:10])


def test_bad_files_are_named_and_leave_nothing(surface, tmp_path):
    mesh = surface_mesh(surface, step_px=80)
    with pytest.raises(ValueError, match=r"\.glb"):
        save_mesh(mesh, tmp_path / "eye.stl")
    with pytest.raises(ValueError, match="x_mm"):
        save_points(tmp_path / "cloud.ply", np.full((4, 3), np.nan))
    with pytest.raises(ValueError, match="colours"):
        save_points(tmp_path / "cloud.ply", np.zeros((4, 3)), colours=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="depth_mm"):
        save_depth_map(tmp_path / "depth.tiff", np.zeros(4))
    with pytest.raises(ValueError, match="step_px"):
        surface_mesh(surface, step_px=0)
    with pytest.raises(FileNotFoundError):
        save_mesh(mesh, tmp_path / "missing" / "eye.glb")
    assert not list(tmp_path.iterdir())
