"""Why images and robot disagree.  Each cause is fitted with a few parameters to the frames since; the likeliest wins."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from lib.calibration.offsets import rows_axes
from lib.cameras import AffineCamera, StereoRig
from lib.correspondences import Correspondences
from lib.registration import MovedCameras, identify_motion

#: Largest mean loss, 8 log(1 + chi^2 / 4), of rows that a rig explains.  About 5.1 is expected, 10 with 1.7 times the noise.
CONVINCING = 10.0
_LATEST, _LATEST_EYE = 25, 5  # largest delays in frames: of the report or both images, and of one camera's images
_CROSSED = [0, 2, 1]  # rows of a frame with the tips exchanged
_LEAST_ZOOM = 0.01  # a smaller change of a camera's zoom, found in few frames, may be noise
_SURE = 10.0  # loss by which another cause must beat a motion of the cameras
_UNDECIDED = 40.0  # loss by which a delay may exceed a motion and stay possible: at first both look alike if the tool glides
_ROBUST = 12.0  # squared Mahalanobis distance at which the weight of a row is one half


@dataclass(frozen=True, eq=False)
class Explanation:
    """The likeliest cause; `kind` is "none", "moved", "optics", "exchanged", "clock", "eye", "slipped" or "open"."""

    kind: str  # "clock": report or images are late; "eye": images of one camera are late; "open": not decided yet
    text: str = ""  # what happened; empty for a motion
    rig: StereoRig | None = None  # the rig that explains the landmarks
    motion: MovedCameras | None = None
    loss: float = float("nan")  # mean over the rows; see `CONVINCING`


def explain(
    rig: StereoRig, frames: Sequence[Correspondences], past: Sequence[Correspondences], covariance_px2: np.ndarray, *,
    undecided: bool = True,
) -> Explanation:  # fmt: skip
    """The likeliest cause of a disagreement between images and robot; a ValueError if the rows determine no motion.

    Args:
        rig: The rig before the disagreement.
        frames: Frames that disagree with it, 3 rows each, oldest first.
        past: The frames before, up to the newest of `frames`, in which delayed reports and images are sought.
        covariance_px2: (n, 4, 4) of the complete rows' residuals.
        undecided: Return "open" if a motion and a delay explain the frames about equally well, since more frames may come.
    """
    data = Correspondences.join(frames).complete
    motion = identify_motion(rig, data, covariance_px2=covariance_px2)
    least = min(motion.bic.values())
    found = Explanation("none", rig=rig) if motion.moved == "none" else Explanation("moved", "", motion.rig, motion)
    swapped = replace(data, u_left=data.u_right, u_right=data.u_left)
    others = [(misfit(rig, swapped, covariance_px2), Explanation("exchanged", "the eyes are exchanged", rig))]
    crossed = (replace(part, u_left=part.u_left[_CROSSED], u_right=part.u_right[_CROSSED]) for part in frames)
    if len(crossed := Correspondences.join(crossed).complete) == len(data):
        others.append((misfit(rig, crossed, covariance_px2), Explanation("exchanged", "the tips are exchanged", rig)))
    late = _delays(rig, frames, past, covariance_px2)
    others += late
    axes = rows_axes(data)
    if np.isfinite(axes).all():
        offset = _offset(rig, data, axes, covariance_px2)
        slipped = replace(data, x_mm=data.x_mm + axes @ offset)
        text = f"the tool slipped by {np.linalg.norm(offset):.2f} mm"
        others.append((misfit(rig, slipped, covariance_px2, 3), Explanation("slipped", text, rig)))
    if rig.is_affine:
        sides = (rig.left, data.u_left), (rig.right, data.u_right)
        choices = (((camera, 1.0), _zoomed(camera, data.x_mm, u, covariance_px2)) for camera, u in sides)
        for (left, zoom_left), (right, zoom_right) in product(*choices):
            changes = np.abs([zoom_left - 1.0, zoom_right - 1.0])
            if changes.max() > _LEAST_ZOOM:
                text = f"the optics changed: zoom x {zoom_left:.3f} left, x {zoom_right:.3f} right"
                fresh = StereoRig(left, right)
                loss = misfit(fresh, data, covariance_px2, 3 * np.count_nonzero(changes))
                others.append((loss, Explanation("optics", text, fresh)))
    best, other = min(others, key=lambda pair: pair[0])
    penalty = {"slipped": 3, "clock": 2, "eye": 2}.get(other.kind, 0) * np.log(2.0 * 2.0 * len(data))
    other = replace(other, loss=(best - penalty) / len(data))
    near = min((value for value, _ in late), default=np.inf) - least <= _UNDECIDED
    if undecided and found.kind == "moved" and near and best >= least - _SURE:
        return Explanation("open", "the cameras moved, or the report or an image is late: not decided yet")
    return other if best < least - _SURE else found


def misfit(rig: StereoRig, data: Correspondences, covariance_px2: np.ndarray, parameters: int = 0) -> float:
    """The loss of complete rows with a rig, comparable with the information criteria (BIC) of `identify_motion`.

    The residuals' covariance is (n, 4, 4), and `parameters` is the number of values that were fitted to these rows.
    """
    try:
        residual = data.stacked_px - np.hstack(rig.project(data.x_mm))
    except ValueError:  # behind a near-affine camera
        return np.inf
    chi2 = np.einsum("ni,ni->n", residual, np.linalg.solve(covariance_px2, residual[:, :, None])[:, :, 0])
    return float(8.0 * np.log1p(chi2 / 4.0).sum() + parameters * np.log(4.0 * len(data)))


def _delays(rig, frames, past, covariance_px2) -> list[tuple[float, Explanation]]:
    """The loss and explanation for each possible delay of the report, of the images, or of one camera's images."""
    number, found = {int(part.frame[0]): part for part in (*past, *frames)}, []
    now = Correspondences.join(frames)
    for delay in range(1, _LATEST + 1):
        earlier = [number.get(int(part.frame[0]) - delay) for part in frames]
        if any(part is None for part in earlier):
            continue
        before = Correspondences.join(earlier)
        cases = {"robot's report is": replace(before, x_mm=now.x_mm), "images are": replace(now, x_mm=before.x_mm)}
        if delay <= _LATEST_EYE:
            sides = {"left images are": {"u_left": now.u_left}, "right images are": {"u_right": now.u_right}}
            cases |= {who: replace(before, **late) for who, late in sides.items()}
        for who, data in cases.items():
            if len(data := data.complete) >= 0.7 * len(covariance_px2):
                # Fewer rows must not make a delay likelier.
                value = misfit(rig, data, np.resize(covariance_px2, (len(data), 4, 4)), 2) * len(covariance_px2) / len(data)
                kind = "eye" if who.split()[0] in ("left", "right") else "clock"
                found.append((value, Explanation(kind, f"the {who} late by {delay} frames", rig)))
    return found


def _offset(rig: StereoRig, data: Correspondences, axes: np.ndarray, covariance_px2: np.ndarray) -> np.ndarray:
    """The common offset (3,) mm of all landmarks from the report, in the tool's axes, by robust least squares."""
    y, weight, offset = data.stacked_px, np.linalg.inv(covariance_px2), np.zeros(3)
    for _ in range(10):
        x = data.x_mm + axes @ offset
        r, J = y - np.hstack(rig.project(x)), rig.jacobian(x) @ axes
        JtW = J.mT @ (weight * (_ROBUST / (_ROBUST + np.einsum("ni,nij,nj->n", r, weight, r)))[:, None, None])
        offset = offset + np.linalg.lstsq((JtW @ J).sum(axis=0), np.einsum("nij,nj->i", JtW, r), rcond=None)[0]
    return offset


def _zoomed(camera: AffineCamera, x_mm: np.ndarray, u: np.ndarray, covariance_px2: np.ndarray) -> tuple[AffineCamera, float]:
    """The camera with its image scaled and shifted to see x_mm at u, by robust least squares; and the scale."""
    variance, weight, seen = np.einsum("nii->n", covariance_px2) / 4.0, np.ones(len(u)), camera.project(x_mm)
    for _ in range(10):
        share = (weight / variance / (weight / variance).sum())[:, None]
        from_middle, at = seen - (share * seen).sum(axis=0), u - (share * u).sum(axis=0)
        scale = float((share * from_middle * at).sum() / (share * from_middle**2).sum())
        weight = _ROBUST / (_ROBUST + ((at - scale * from_middle) ** 2).sum(axis=1) / variance)
    shift = (share * (u - scale * seen)).sum(axis=0)
    return AffineCamera(scale * camera.matrix + np.column_stack([np.zeros((2, 3)), shift])), scale
