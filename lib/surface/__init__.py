"""Robust bicubic B-spline surfaces from semi-dense stereo points (paper Sec. IV-B), and their files."""

from lib.surface.bspline import BSplineSurface, ToolDistance, fit_surface
from lib.surface.export import Mesh, open3d, save_map, save_mesh, save_points, surface_mesh
from lib.surface.grid import SplineGrid
from lib.surface.reconstruct import Reconstruction, epipolar_inliers, reconstruct, refine_rig

__all__ = ["BSplineSurface", "Mesh", "Reconstruction", "SplineGrid", "ToolDistance"]
__all__ += ["epipolar_inliers", "fit_surface", "open3d", "reconstruct", "refine_rig"]
__all__ += ["save_map", "save_mesh", "save_points", "surface_mesh"]
