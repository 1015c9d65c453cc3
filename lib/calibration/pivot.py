"""Tool offsets: positions of the landmarks in the tool's frame, for robots that report a pose and no landmarks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from lib.calibration.affine import camera_columns, estimate_noise, regress
from lib.calibration.scatter import sandwich
from lib.geometry import RigidTransform
from lib.least_squares import minimise

_TURN = 0.02  # least RMS turn (rad) about a second axis: 10 um of robot noise then give an sd of 0.5 mm / sqrt(poses)
_OPENING = 0.03  # least range of half the opening (rad): it moves the end of a 3 mm jaw by 100 um
_SHIFT_MM = 0.05  # least RMS distance of a tool that moves from one that only turns about a point: it gives the scale
_NOISE_LEVELS = 4  # number of estimates of the noise levels
_LARGEST_SD_MM = 1.0  # largest standard deviation of an offset's coordinate; above it the offset counts as undetermined


@dataclass(frozen=True, eq=False)
class Pivot:
    """`offset_mm` (3,) in the tool frame, the fixed `point_mm` (3,) in the robot frame, their (6, 6) covariance, the RMS."""

    offset_mm: np.ndarray
    point_mm: np.ndarray
    covariance_mm2: np.ndarray
    rms_mm: float


@dataclass(frozen=True, eq=False)
class Tool:
    """Landmarks in the tool frame, at the full angle o between the jaws: offset + sin(o / 2) sine + (1 - cos(o / 2)) versine.

    Attributes:
        offset_mm: (k, 3) positions of the landmarks when the jaws are closed.
        sine_mm, versine_mm: (k, 3) coefficients of their motion as the jaws open; 0 for a fixed landmark.
    """

    offset_mm: np.ndarray
    sine_mm: np.ndarray
    versine_mm: np.ndarray

    @classmethod
    def hinged(
        cls, offset_mm: ArrayLike, turning: ArrayLike, point_mm: ArrayLike, axis: ArrayLike, jaw_mm: ArrayLike
    ) -> Self:
        """A tool with a hinge: an axis through `point_mm`, and the vector `jaw_mm` from there to the tips of the closed jaws.

        `turning` (k,) is 1 for a landmark that turns positively about the axis, -1 negatively, 0 if fixed at its `offset_mm`.

        >>> tool = Tool.hinged(np.zeros((3, 3)), [0, 1, -1], [0, 0, 0], [0, 0, 1], [3, 0, 0])
        >>> tool.positions_mm([RigidTransform.identity()], [np.pi / 3])[0].round(2).tolist()
        [[0.0, 0.0, 0.0], [2.6, 1.5, 0.0], [2.6, -1.5, 0.0]]
        """
        side = np.asarray(turning, np.float64)[:, None]
        axis, jaw = np.asarray(axis, np.float64), np.asarray(jaw_mm, np.float64)
        if not np.linalg.norm(np.cross(axis, jaw)) > 1e-6:
            raise ValueError("axis, jaw_mm: the jaw lies along the axis, or one of them is zero; no opening would move it.")
        axis = axis / np.linalg.norm(axis)
        offset = np.where(side == 0, offset_mm, np.asarray(point_mm, np.float64) + jaw)
        return cls(offset, side * np.cross(axis, jaw), -np.abs(side) * (jaw - axis * (axis @ jaw)))

    def positions_mm(self, robot_from_tool: Sequence[RigidTransform], opening_rad: ArrayLike | None = None) -> np.ndarray:
        """(n, k, 3) landmark positions in the robot frame at the poses, as `calibrate` and recordings need them."""
        half = np.zeros(len(robot_from_tool)) if opening_rad is None else np.asarray(opening_rad, np.float64) / 2
        turn = np.sin(half)[:, None, None] * self.sine_mm + (1 - np.cos(half))[:, None, None] * self.versine_mm
        return np.stack([pose.apply(x) for pose, x in zip(robot_from_tool, self.offset_mm + turn, strict=True)])


@dataclass(frozen=True, eq=False)
class ToolOffsets(Tool):
    """An estimated tool, with the covariance of `offset_mm`, (k, 3, 3) mm^2, and the RMS error in an image."""

    covariance_mm2: np.ndarray
    rms_px: float


def pivot_calibration(robot_from_tool: Sequence[RigidTransform]) -> Pivot:
    """Classical pivot calibration: the tip rests at one point c while the tool turns, R_i p + t_i = c.

    A ValueError refuses fewer than three poses, rotations about only one axis, and a tip that did not rest.

    >>> R = [RigidTransform.from_rotation_vector(v).R for v in ((0, 0, 0), (0.4, 0, 0), (0, 0.4, 0), (-0.3, 0.2, 0))]
    >>> tip, rest = np.array([2.0, 1.0, 12.0]), np.array([5.0, 5.0, 5.0])
    >>> pivot_calibration([RigidTransform(r, rest - r @ tip) for r in R]).offset_mm.round(6).tolist()
    [2.0, 1.0, 12.0]
    """
    R, t = _poses(robot_from_tool)
    n = len(R)
    design, solution, r = _resting_point(R, t)
    covariance = float(r @ r) / max(3 * n - 6, 1) * np.linalg.inv(design.T @ design)
    rms, spread = float(np.sqrt(r @ r / n)), float(np.sqrt(((t - t.mean(axis=0)) ** 2).sum() / n))
    if rms > max(0.25 * spread, 0.05):
        raise ValueError(f"robot_from_tool: the tip did not rest ({rms:.2f} mm RMS): hold it in a divot or use tool_offsets.")
    _check_determined(covariance[:3, :3])
    return Pivot(solution[:3], solution[3:], covariance, rms)


def tool_offsets(
    robot_from_tool: Sequence[RigidTransform], u: Sequence[ArrayLike], *,
    opening_rad: ArrayLike | None = None, turning: ArrayLike | None = None,
) -> ToolOffsets:  # fmt: skip
    """Estimates landmark offsets and affine cameras together, from poses and images: y = A (R_i p_k + t_i) + t.

    Damped Gauss-Newton on both, with an initial value from the relaxed problem that is linear in (A, A (x) p, t).  A
    landmark on a jaw has p_k = offset + sin(o_i / 2) sine + (1 - cos(o_i / 2)) versine at the opening o_i; this is linear
    for any hinge.

    Args:
        robot_from_tool: n poses; the tool must be turned about at least two axes, and moved.
        u: One array a camera, (n, k, 2) px; NaN = missing.
        opening_rad: (n,) full angle between the jaws; None is a tool without a hinge.
        turning: (k,) not 0 for landmarks on a jaw; None is all but the first.

    A ValueError refuses too few poses, a tool that only turns about one point, and motion that does not determine the offsets
    or the hinge.  Outliers are not removed: look at `rms_px`.
    """
    R, t = _poses(robot_from_tool)
    rests_mm = np.linalg.norm(_resting_point(R, t)[2]) / np.sqrt(len(R))
    if rests_mm < _SHIFT_MM:
        what = f"the tool only turns about one point (to {rests_mm:.2g} mm RMS), which leaves its size open"
        raise ValueError(f"robot_from_tool: {what}; move it through the volume as well.")
    images = [np.asarray(pixels, dtype=np.float64) for pixels in u]
    if any(i.ndim != 3 or i.shape[0] != len(R) or i.shape[2] != 2 or i.shape != images[0].shape for i in images):
        raise ValueError(f"u: expected ({len(R)}, k, 2) pixels a camera, got {[i.shape for i in images]}.")
    y = np.concatenate(images, axis=2)
    k, m = y.shape[1:]
    half = None if opening_rad is None else np.asarray(opening_rad, np.float64) / 2
    if half is not None and (half.shape != (len(R),) or np.nanmax(np.abs(half), initial=0.0) > np.pi / 2):
        raise ValueError(f"opening_rad: expected ({len(R)},) angles of at most pi, in radians; got {half.shape}.")
    if not (found := np.isfinite(y).all(axis=2).any(axis=0)).all():
        raise ValueError(f"u: landmark {int(np.argmin(found))} is in no frame seen by every camera; leave it out.")
    if turning is not None and np.shape(turning) != (k,):
        raise ValueError(f"turning: expected ({k},), one number a landmark, got {np.shape(turning)}.")
    frame, landmark = np.nonzero(np.isfinite(y).all(axis=2) & (True if half is None else np.isfinite(half)[:, None]))
    pixels, R, t = y[frame, landmark], R[frame], t[frame]
    own = (landmark[:, None] == np.arange(k)).astype(np.float64)
    on_jaw = np.arange(k) > 0 if turning is None else np.asarray(turning) != 0
    if half is not None:
        seen = half[frame[on_jaw[landmark]]]
        if (span := float(np.ptp(seen)) if seen.size else 0.0) < _OPENING:
            what = f"the jaws open by only {2 * span:.2g} rad, which does not determine the hinge"
            raise ValueError(f"opening_rad: {what}; open and close them, or leave the opening out.")
        jaw = own[:, on_jaw]
        own = np.hstack([own, np.sin(half[frame])[:, None] * jaw, (1 - np.cos(half[frame]))[:, None] * jaw])
    q = own.shape[1]
    if pixels.size < 4 * m + 3 * q:
        raise ValueError(f"u: {len(pixels)} detections are too few for {q} vectors of the tool and the cameras.")
    scale = t.std()
    # Initial value: the problem is linear in A, B_k = A (x) p_k and t; p_k is the least-squares solution of B_k = A (x) p_k.
    lifted = (own[:, :, None] * R.reshape(-1, 1, 9)).reshape(-1, 9 * q)
    solution = np.linalg.lstsq(np.hstack([t / scale, np.ones((len(t), 1)), lifted]), pixels, rcond=1e-6)[0]
    A, B = solution[:3].T, solution[4:].reshape(q, 3, 3, -1)  # B: vector, row of R (with A), column (with p), pixel
    offset = np.einsum("kijm,mi->kj", B, A) / (A**2).sum() * scale

    def evaluate(offset: np.ndarray) -> tuple[float, tuple[np.ndarray, ...]]:
        """Energy; points, cameras and residuals.  The weights are the same for all rows, so they change no camera."""
        x = np.einsum("nij,nj->ni", R, own @ offset) + t
        matrix = regress(x, pixels)
        r = pixels - x @ matrix[:, :3].T - matrix[:, 3]
        return 0.5 * float(((r @ root.T) ** 2).sum()), (x, matrix, r)

    def derivatives(x: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """(n, m, 3 q) by the vectors.  Variable projection (Kaufman): the cameras are linear, so they are eliminated."""
        J = ((matrix[:, :3] @ R)[:, :, None] * own[:, None, :, None]).reshape(len(x), m, 3 * q)
        Q = np.linalg.qr(np.column_stack([x - x.mean(axis=0), np.ones(len(x))]))[0]
        return J - np.tensordot(Q, np.tensordot(Q.T, J, axes=1), axes=1)

    def normal_equations(_: np.ndarray, work: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
        flat = (root @ derivatives(*work[:2])).reshape(-1, 3 * q)
        return flat.T @ flat, flat.T @ (work[2] @ root.T).ravel()

    root = np.eye(m)  # whitens the noise, which is estimated after each minimum
    for _ in range(_NOISE_LEVELS):
        found = minimise(offset, evaluate, normal_equations, lambda offset, step: offset + step.reshape(q, 3))
        offset, (x, matrix, r) = found.state, found.work
        sigma_u, sigma_x = estimate_noise(r, matrix[:, :3], 4 * m + 3 * q)
        noise_px2 = max(sigma_u, 1e-9) ** 2 * np.eye(m) + sigma_x**2 * matrix[:, :3] @ matrix[:, :3].T
        root = np.linalg.inv(np.linalg.cholesky(noise_px2))
    J = derivatives(x, matrix)
    information = normal_equations(offset, found.work)[0]
    if np.linalg.cond(information) > 1e13:
        raise ValueError("robot_from_tool: the motion does not determine the offsets; turn the tool about two axes.")
    both, weight = np.concatenate([J, camera_columns(x - x.mean(axis=0), m)], axis=2), np.linalg.inv(noise_px2)[None]
    covariance = sandwich(both, weight, r, matrix[None, :, :3], frame, landmark)[0][: 3 * q, : 3 * q].reshape(q, 3, q, 3)
    # Check the covariance of the landmarks at each opening that occurs: a vector of little effect may have a large one.
    _check_determined(np.einsum("na,aibj,nb->nij", own, covariance, own))
    blocks = covariance[np.arange(k), :, np.arange(k)]
    sine, versine = np.zeros((2, k, 3))
    if half is not None:
        sine[on_jaw], versine[on_jaw] = np.split(offset[k:], 2)
    return ToolOffsets(offset[:k], sine, versine, blocks, float(np.sqrt((r**2).sum() / (len(r) * m / 2))))


def _poses(robot_from_tool: Sequence[RigidTransform]) -> tuple[np.ndarray, np.ndarray]:
    if len(robot_from_tool) < 3:
        raise ValueError(f"robot_from_tool: {len(robot_from_tool)} poses; three with different rotations are needed.")
    R, t = np.stack([p.R for p in robot_from_tool]), np.stack([p.t for p in robot_from_tool])
    # An offset shows only in rotations that move the landmark, so at least two axes are needed.
    if np.linalg.svd((R - R.mean(axis=0)).reshape(-1, 3), compute_uv=False)[2] < _TURN * np.sqrt(len(R)):
        raise ValueError("robot_from_tool: the tool hardly turns, or about only one axis; rotate it about two axes.")
    return R, t


def _resting_point(R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least-squares solution (p, c) of R_i p + t_i = c: its design matrix (3 n, 6), (p, c) and the residuals (3 n,)."""
    design = np.concatenate([R, np.broadcast_to(-np.eye(3), (len(R), 3, 3))], axis=2).reshape(-1, 6)
    solution = np.linalg.lstsq(design, -t.ravel(), rcond=None)[0]
    return design, solution, design @ solution + t.ravel()


def _check_determined(covariance_mm2: np.ndarray) -> None:
    variance = np.diagonal(covariance_mm2, axis1=-2, axis2=-1)
    if not ((variance >= 0) & (variance < _LARGEST_SD_MM**2)).all():
        sd_mm = np.sqrt(np.abs(variance).max())
        raise ValueError(f"robot_from_tool: an offset has a standard deviation of {sd_mm:.2g} mm; turn more, about two axes.")
