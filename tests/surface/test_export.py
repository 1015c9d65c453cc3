"""Meshes, point clouds and depth maps: written, read back by another program, whole or not at all."""

from __future__ import annotations

import json
import os
import struct
import sys
from contextlib import suppress

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from lib.surface import (
    fit_surface,
    open3d,
    save_map,
    save_mesh,
    save_points,
    surface_mesh,
)
from notebooks.figures.reconstruction import vertex_colours


@pytest.fixture(scope="module", autouse=True)
def _open3d():
    """Imported by the one process that runs these tests: it takes seconds."""
    global o3d
    missing = "Open3D's system libraries are missing"
    o3d = pytest.importorskip("open3d", exc_type=(ImportError, OSError), reason=missing)


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
    np.testing.assert_array_equal(vertex_colours(mesh), image[nearest[:, 1], nearest[:, 0]])


def test_mask_hides_triangles(surface):
    mask = np.zeros((1080, 1920), dtype=bool)
    mask[:, :960] = True
    mesh = surface_mesh(surface, step_px=40, mask=mask)
    assert mesh.u[:, 0].max() < 960 and mesh.faces.max() == len(mesh.u) - 1
    with pytest.raises(ValueError, match="mask"):
        surface_mesh(surface, mask=np.zeros_like(mask))


@pytest.mark.parametrize("size", [(10, 10), (1080, 960), (1920, 1080), (1080,)])
def test_a_mask_of_another_image_is_refused(surface, size):
    with pytest.raises(ValueError, match="mask: expected"):
        surface_mesh(surface, mask=np.ones(size, dtype=bool))


def test_a_mask_has_the_size_of_the_texture(surface, image):
    with pytest.raises(ValueError, match="mask: expected"):
        surface_mesh(surface, image=image, mask=np.ones((1200, 2000), dtype=bool))


@pytest.mark.parametrize("textured", [True, False])
def test_glb_is_glTF_in_metres_with_its_texture(surface, image, tmp_path, textured):
    mesh = surface_mesh(surface, step_px=60, image=image if textured else None)
    path = save_mesh(mesh, tmp_path / "eye.glb")
    assert [p.name for p in tmp_path.iterdir()] == ["eye.glb"]
    content = path.read_bytes()
    magic, version, length, size = struct.unpack_from("<4sIII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    document, body = json.loads(content[20 : 20 + size]), content[28 + size :]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]

    def read(name: str, width: int) -> np.ndarray:
        accessor = document["accessors"][attributes[name]]
        start = document["bufferViews"][accessor["bufferView"]].get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(body, "<f4", accessor["count"] * width, start).reshape(-1, width)

    distance, index = KDTree(mesh.vertices_mm).query(1000 * read("POSITION", 3).astype(float))
    assert distance.max() < 1e-3 and len(np.unique(index)) == len(mesh.vertices_mm)
    np.testing.assert_allclose(read("NORMAL", 3), mesh.normals[index], atol=1e-5)
    assert ("images" in document) == textured
    if textured:  # glTF counts from the upper left corner of the image
        np.testing.assert_allclose(read("TEXCOORD_0", 2), ((mesh.u + 0.5) / (1920, 1080))[index], atol=1e-5)
        view = document["bufferViews"][document["images"][0]["bufferView"]]
        encoded = np.frombuffer(body, np.uint8, view["byteLength"], view.get("byteOffset", 0))
        stored = cv2.imdecode(encoded, cv2.IMREAD_COLOR)[..., ::-1]
        assert stored.shape == image.shape and np.abs(stored.astype(int) - image).mean() < 3


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits the size of files")
def test_a_full_disk_is_an_error_and_the_old_file_stays(surface, tmp_path):
    import resource

    mesh = surface_mesh(surface, step_px=60)
    save_points(tmp_path / "cloud.ply", np.zeros((4, 3)))
    before, limit = (tmp_path / "cloud.ply").read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4000, limit[1]))  # what is longer fails, as on a full disk
        with pytest.raises(OSError, match="cloud"):
            save_points(tmp_path / "cloud.ply", mesh.vertices_mm)
        with pytest.raises(OSError, match="eye"):
            save_mesh(mesh, tmp_path / "eye.glb")
        with pytest.raises(OSError):
            save_map(tmp_path / "depth.tiff", np.zeros((100, 100)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.ply"]
    assert (tmp_path / "cloud.ply").read_bytes() == before


def test_without_open3d_one_line_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match="apt-get install") as failure:
        save_points(tmp_path / "cloud.ply", np.zeros((4, 3)))
    assert "\n" not in str(failure.value)


def test_ply_comes_back_with_colours(surface, image, bowl, tmp_path):
    mesh = surface_mesh(surface, step_px=80, image=image)
    colours = vertex_colours(mesh)
    path = save_points(tmp_path / "cloud.ply", mesh.vertices_mm, colours=colours)
    assert [p.name for p in tmp_path.iterdir()] == ["cloud.ply"]
    cloud = o3d.io.read_point_cloud(str(path))
    np.testing.assert_allclose(np.asarray(cloud.points), mesh.vertices_mm, atol=1e-6)
    np.testing.assert_array_equal(np.rint(np.asarray(cloud.colors) * 255), colours)


def test_depth_map_is_the_surface_along_the_view(surface, bowl, tmp_path):
    depth = surface.on_grid(np.arange(1920), np.arange(1080)) @ bowl.rig.left.viewing_direction
    assert depth.shape == (1080, 1920) and np.isnan(depth[0, 0])
    x = surface([[700.0, 400.0]])[0]
    assert depth[400, 700] == pytest.approx(x @ bowl.rig.left.viewing_direction, abs=1e-5)
    path = save_map(tmp_path / "depth.tiff", depth)
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), depth.astype(np.float32))


def test_bad_files_are_named_and_leave_nothing(surface, tmp_path):
    mesh = surface_mesh(surface, step_px=80)
    with pytest.raises(ValueError, match=r"\.glb"):
        save_mesh(mesh, tmp_path / "eye.stl")
    with pytest.raises(ValueError, match="x_mm"):
        save_points(tmp_path / "cloud.ply", np.full((4, 3), np.nan))
    with pytest.raises(ValueError, match="colours"):
        save_points(tmp_path / "cloud.ply", np.zeros((4, 3)), colours=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="values_mm"):
        save_map(tmp_path / "depth.tiff", np.zeros(4))
    with pytest.raises(ValueError, match="step_px"):
        surface_mesh(surface, step_px=0)
    with pytest.raises(FileNotFoundError):
        save_mesh(mesh, tmp_path / "missing" / "eye.glb")
    assert not list(tmp_path.iterdir())


def test_open3d_starts_without_its_web_visualizer(monkeypatch):
    """In JupyterLab that prints lines at each import; whoever wants it says so in the environment."""
    for value, after in ((None, "true"), ("false", "false")):
        monkeypatch.delenv("OPEN3D_DISABLE_WEB_VISUALIZER", raising=False)
        if value:
            monkeypatch.setenv("OPEN3D_DISABLE_WEB_VISUALIZER", value)
        with suppress(ImportError):  # its system libraries may be missing
            open3d()
        assert os.environ["OPEN3D_DISABLE_WEB_VISUALIZER"] == after
