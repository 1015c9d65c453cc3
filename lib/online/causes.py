"""Why do images and robot disagree?  Each cause fits a few numbers to the frames since; the likeliest wins."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from lib.calibration.offsets import rows_axes
from lib.cameras import AffineCamera, StereoRig
from lib.correspondences import Correspondences
from lib.registration import MovedCameras, identify_motion

#: Rows that a rig explains lose about 5.1 each, 8 log(1 + chi^2 / 4), with 1.7 times the noise 10.
CONVINCING = 10.0
_LATEST, _LATEST_EYE = 25, 5  # frames by which a report, and the images of one camera, may be late
_CROSSED = [0, 2, 1]  # rows of a frame with the tips exchanged
_LEAST_ZOOM = 0.01  # a smaller change of a camera's zoom, found in few frames, may be noise
_PLAIN = 10.0  # by how much less likely the motion of a camera must be than any other cause
_OPEN = 40.0  # the same, for a tool that glides: a late report and a shift of the cameras then look alike at first
_ROBUST = 12.0  # squared residual in standard deviations that begins to count less


@dataclass(frozen=True, eq=False)
class Explanation:
    """The likeliest cause: "none", "moved", "optics", "exchanged", "clock", "eye" (is late), "slipped" or "open"."""

    kind: str
    text: str = ""  # what happened, where it is no motion
    rig: StereoRig | None = None  # that explains the landmarks
    motion: MovedCameras | None = None
    loss: float = float("nan")  # of a row, the mean over the rows; see `CONVINCING`


def explain(
    rig: StereoRig, frames: Sequence[Correspondences], past: Sequence[Correspondences], covariance_px2: np.ndarray, *,
    undecided: bool = True,
) -> Explanation:  # fmt: skip
    """The likeliest cause of what `frames` show; a ValueError if the landmarks leave every motion open.

    Args:
        rig: In force before.
        frames: Frames that disagree with it, 3 rows each, oldest first.
        past: Some twenty frames up to the newest of `frames`, and those themselves.
        covariance_px2: (n, 4, 4) of the complete rows' residuals.
        undecided: More frames may come: answer "open" where a motion and a late report explain these about equally well.
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
    late = _lateness(rig, frames, past, covariance_px2)
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
    near = min((value for value, _ in late), default=np.inf) - least <= _OPEN
    if undecided and found.kind == "moved" and near and best >= least - _PLAIN:
        return Explanation("open", "the cameras moved, or the report or an image is late: not decided yet")
    return other if best < least - _PLAIN else found


def misfit(rig: StereoRig, data: Correspondences, covariance_px2: np.ndarray, parameters: int = 0) -> float:
    """How badly a rig explains complete rows, as the information criteria of `identify_motion` say it.

    The residuals' covariance is (n, 4, 4), and `parameters` is the number of values that were fitted to these rows.
    """
    try:
        residual = data.stacked_px - np.hstack(rig.project(data.x_mm))
    except ValueError:  # behind a near-affine camera
        return np.inf
    chi2 = np.einsum("ni,ni->n", residual, np.linalg.solve(covariance_px2, residual[:, :, None])[:, :, 0])
    return float(8.0 * np.log1p(chi2 / 4.0).sum() + parameters * np.log(4.0 * len(data)))


def _lateness(rig, frames, past, covariance_px2) -> list[tuple[float, Explanation]]:
    """How badly delays of the report, of the images, or of one camera's images explain the frames."""
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
    """(3,) mm in the tool's axes by which all landmarks lie off the report, robustly."""
    y, weight, offset = data.stacked_px, np.linalg.inv(covariance_px2), np.zeros(3)
    for _ in range(10):
        x = data.x_mm + axes @ offset
        r, J = y - np.hstack(rig.project(x)), rig.jacobian(x) @ axes
        JtW = J.mT @ (weight * (_ROBUST / (_ROBUST + np.einsum("ni,nij,nj->n", r, weight, r)))[:, None, None])
        offset = offset + np.linalg.lstsq((JtW @ J).sum(axis=0), np.einsum("nij,nj->i", JtW, r), rcond=None)[0]
    return offset


def _zoomed(camera: AffineCamera, x_mm: np.ndarray, u: np.ndarray, covariance_px2: np.ndarray) -> tuple[AffineCamera, float]:
    """The camera with its image scaled and shifted so that x_mm is seen at u, robustly; and that scale."""
    variance, weight, seen = np.einsum("nii->n", covariance_px2) / 4.0, np.ones(len(u)), camera.project(x_mm)
    for _ in range(10):
        share = (weight / variance / (weight / variance).sum())[:, None]
        from_middle, at = seen - (share * seen).sum(axis=0), u - (share * u).sum(axis=0)
        scale = float((share * from_middle * at).sum() / (share * from_middle**2).sum())
        weight = _ROBUST / (_ROBUST + ((at - scale * from_middle) ** 2).sum(axis=1) / variance)
    shift = (share * (u - scale * seen)).sum(axis=0)
    return AffineCamera(scale * camera.matrix + np.column_stack([np.zeros((2, 3)), shift])), scale
