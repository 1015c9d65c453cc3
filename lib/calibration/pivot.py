"""Tool offsets: where a landmark sits in the tool's own frame, for robots that report a pose and no landmarks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.affine import Moments, affine_minimum
from lib.cameras import AffineCamera
from lib.geometry import RigidTransform

__all__ = ["Pivot", "ToolOffsets", "pivot_calibration", "tool_offsets"]

_TURN = 0.02  # least RMS turn (rad) about a second axis: 10 um of the robot's noise then leave 0.5 mm / sqrt(poses)
_LARGEST_SD_MM = 1.0  # of an offset's coordinate; beyond it the motion determines nothing


@dataclass(frozen=True, eq=False)
class Pivot:
    """`offset_mm` (3,) in the tool frame, the fixed `point_mm` (3,) in the robot frame, (6, 6) covariance of both, RMS."""

    offset_mm: np.ndarray
    point_mm: np.ndarray
    covariance_mm2: np.ndarray
    rms_mm: float


@dataclass(frozen=True, eq=False)
class ToolOffsets:
    """Landmarks in the tool frame, `offset_mm` (k, 3), their covariance (k, 3, 3) mm^2, and the cameras found with them."""

    offset_mm: np.ndarray
    covariance_mm2: np.ndarray
    cameras: tuple[AffineCamera, ...]
    rms_px: float

    def positions_mm(self, robot_from_tool: Sequence[RigidTransform]) -> np.ndarray:
        """(n, k, 3) landmark positions in the robot frame at the poses: what `calibrate` and a recording want."""
        return np.stack([pose.apply(self.offset_mm) for pose in robot_from_tool])


def pivot_calibration(robot_from_tool: Sequence[RigidTransform]) -> Pivot:
    """Classical pivot calibration: the tip rests in one point while the tool turns, R_i p + t_i = c.

    Raises:
        ValueError: For fewer than three poses, rotations about one axis only, or a tip that did not rest.

    >>> R = [RigidTransform.from_rotation_vector(v).R for v in ((0, 0, 0), (0.4, 0, 0), (0, 0.4, 0), (-0.3, 0.2, 0))]
    >>> tip, rest = np.array([2.0, 1.0, 12.0]), np.array([5.0, 5.0, 5.0])
    >>> pivot_calibration([RigidTransform(r, rest - r @ tip) for r in R]).offset_mm.round(6).tolist()
    [2.0, 1.0, 12.0]
    """
    R, t = _poses(robot_from_tool)
    n = len(R)
    design = np.concatenate([R, np.broadcast_to(-np.eye(3), (n, 3, 3))], axis=2).reshape(-1, 6)
    solution = np.linalg.lstsq(design, -t.ravel(), rcond=None)[0]
    r = design @ solution + t.ravel()
    covariance = float(r @ r) / max(3 * n - 6, 1) * np.linalg.inv(design.T @ design)
    rms, spread = float(np.sqrt((r**2).sum() / n)), float(np.sqrt(((t - t.mean(axis=0)) ** 2).sum() / n))
    if rms > max(0.25 * spread, 0.05):
        raise ValueError(f"robot_from_tool: the tip did not rest ({rms:.2f} mm RMS): hold it in a divot or use tool_offsets.")
    _check_determined(covariance[:3, :3])
    return Pivot(solution[:3], solution[3:], covariance, rms)


def tool_offsets(robot_from_tool: Sequence[RigidTransform], u: Sequence[ArrayLike], iterations: int = 100) -> ToolOffsets:
    """Landmark offsets and affine cameras together, from poses and images: y = A (R_i p_k + t_i) + o.

    Gauss-Newton on both, started from the lifted problem that is linear in (A, A (x) p, o).

    Args:
        robot_from_tool: n poses, the tool turned about at least two axes.
        u: One array a camera, (n, k, 2) px; NaN = missing.

    Raises:
        ValueError: For too few poses, motion that does not determine the offsets, or shapes that do not match.
    """
    R, t = _poses(robot_from_tool)
    images = [np.asarray(pixels, dtype=np.float64) for pixels in u]
    if any(i.ndim != 3 or i.shape[0] != len(R) or i.shape[2] != 2 or i.shape != images[0].shape for i in images):
        raise ValueError(f"u: expected ({len(R)}, k, 2) pixels a camera, got {[i.shape for i in images]}.")
    y = np.concatenate(images, axis=2)
    k, m = y.shape[1:]
    frame, landmark = np.nonzero(np.isfinite(y).all(axis=2))
    pixels, R, t = y[frame, landmark], R[frame], t[frame]
    if pixels.size < 4 * m + 3 * k:
        raise ValueError(f"u: {len(pixels)} detections are too few for {k} offsets and the cameras.")
    own = landmark[:, None] == np.arange(k)
    scale = t.std()
    offset = _lifted_start(R, t / scale, pixels, own) * scale
    for _ in range(iterations):
        x = np.einsum("nij,nj->ni", R, offset[landmark]) + t
        matrix = affine_minimum(Moments.of(x, pixels), 1.0, 0.0).matrix
        r = pixels - x @ matrix[:, :3].T - matrix[:, 3]
        # Variable projection (Kaufman): the cameras are linear, so their columns are swept out of the offsets'.
        J = ((matrix[:, :3] @ R)[:, :, None] * own[:, None, :, None]).reshape(len(x), m, 3 * k)
        Q = np.linalg.qr(np.column_stack([x - x.mean(axis=0), np.ones(len(x))]))[0]
        J -= np.tensordot(Q, np.tensordot(Q.T, J, axes=1), axes=1)
        flat = J.reshape(-1, 3 * k)
        step = np.linalg.lstsq(flat, r.ravel(), rcond=None)[0]
        offset = offset + step.reshape(k, 3)
        if np.abs(step).max() < 1e-9 * scale:
            break
    covariance = float((r**2).sum()) / max(r.size - 4 * m - 3 * k, 1) * np.linalg.inv(flat.T @ flat)
    blocks = np.stack([covariance[j : j + 3, j : j + 3] for j in range(0, 3 * k, 3)])
    _check_determined(blocks)
    cameras = tuple(AffineCamera(matrix[2 * c : 2 * c + 2]) for c in range(m // 2))
    return ToolOffsets(offset, blocks, cameras, float(np.sqrt((r**2).sum() / (len(r) * m / 2))))


def _poses(robot_from_tool: Sequence[RigidTransform]) -> tuple[np.ndarray, np.ndarray]:
    if len(robot_from_tool) < 3:
        raise ValueError(f"robot_from_tool: {len(robot_from_tool)} poses; three with different rotations are needed.")
    R, t = np.stack([p.R for p in robot_from_tool]), np.stack([p.t for p in robot_from_tool])
    # A landmark is seen only through rotations that move it: two different axes at least.
    if np.linalg.svd((R - R.mean(axis=0)).reshape(-1, 3), compute_uv=False)[2] < _TURN * np.sqrt(len(R)):
        raise ValueError("robot_from_tool: the tool hardly turns, or about one axis only; rotate it about two axes.")
    return R, t


def _check_determined(covariance_mm2: np.ndarray) -> None:
    variance = np.diagonal(covariance_mm2, axis1=-2, axis2=-1)
    if not ((variance >= 0) & (variance < _LARGEST_SD_MM**2)).all():
        raise ValueError(
            f"robot_from_tool: the motion leaves an offset open by {np.sqrt(np.abs(variance).max()):.2g} mm; turn the tool "
            "further, about two axes, or give more poses."
        )


def _lifted_start(R: np.ndarray, t: np.ndarray, y: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Offsets (k, 3) from the linear problem in A, B_k = A (x) p_k and o, whose rank is restored by least squares."""
    n, k = own.shape
    lifted = (own[:, :, None] * R.reshape(n, 1, 9)).reshape(n, 9 * k)
    solution = np.linalg.lstsq(np.hstack([t, np.ones((n, 1)), lifted]), y, rcond=1e-6)[0]
    A = solution[:3].T  # (m, 3)
    B = solution[4:].reshape(k, 3, 3, -1)  # landmark, row of R (pairs with A), column of R (pairs with p), pixel
    return np.einsum("kijm,mi->kj", B, A) / (A**2).sum()
