"""Whole recordings with known truth, in the format of `lib.recordings`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from tqdm.auto import tqdm

from lib.cameras import AffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.recordings import Recording, RecordingWriter
from lib.simulator.eye import Eye, Scene
from lib.simulator.forceps import Forceps
from lib.simulator.microscope import Microscope
from lib.simulator.motion import Motion
from lib.simulator.population import RESERVED_SEEDS, reserved_forceps
from lib.simulator.render import View, render_pair, surface_grid
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE

__all__ = ["simulate"]

_KINEMATICS_HZ = 100.0
_GLINT_REACH_PX = 3  # a detector looks at a landmark's surroundings, not at one pixel
_CLIPPED = 250  # of 255


def simulate(
    folder: str | Path,
    *,
    seed: int = 0,
    n_frames: int = 40,
    motion: str | Motion = "both",
    eye: Scene | None = None,
    forceps: Forceps | None = None,
    microscope: Microscope | None = None,
    robot_from_microscope: RigidTransform = ROBOT_FROM_MICROSCOPE,
    duration_s: float | None = None,
    fps: float = 25.0,
    offset_s: float = 0.0,
    dropout: float = 0.0,
    robot_accuracy_mm: float = 0.010,
    click_px: float = 1.0,
    camera_motion: tuple[int, RigidTransform] | None = None,
    masks: bool = False,
    name: str | None = None,
    description: str = "",
    progress: bool | Callable[[], object] = True,
    overwrite: bool = False,
) -> Recording:
    """Simulate a recording and write it to `folder`, which appears whole or not at all.

    Frames are spread over the motion: the video is kept at every k-th frame of `fps`, as the times in frames.csv
    say.  The same arguments give the same files.

    Parameters
    ----------
    seed:
        Drives every random source; also chooses eye and forceps where they are None, from designs that
        `lib.simulator.population.sample` never draws.
    motion:
        "sweep" (calibration), "surgeon", "both", or a `Motion`.
    microscope:
        With a finite working distance the truth's rig is the affine one that touches the cameras in the focal plane,
        and the truth's landmarks in the images are those of the cameras.
    robot_from_microscope:
        Where the microscope stands; the recording is in the robot frame.
    duration_s:
        Of the motion; None is 30 s for a sweep, 18 s for a surgeon, 45 s for both.
    offset_s:
        t_robot = t_video + offset_s.
    dropout:
        Share of kinematic samples without values.
    click_px:
        Standard deviation per coordinate of the annotations.
    camera_motion:
        (frame, microscope_after_from_before): from that frame on the microscope has moved over eye and robot.  The
        truth's rig is the one before; ``truth/moved_rig.json`` holds the one after.
    masks:
        Also write ``truth/masks``: tool and glints of every frame (PNG, red and green channel).
    progress:
        Whether to show a bar, or what to call after every pair.

    Raises
    ------
    ValueError
        If a parameter is out of range.
    FileExistsError
        If the folder exists and `overwrite` is False.
    """
    if n_frames < 1:
        raise ValueError(f"n_frames: must be at least 1, got {n_frames}.")
    if not 0 <= dropout < 1:
        raise ValueError(f"dropout: a share, at least 0 and below 1, got {dropout}.")
    if robot_accuracy_mm < 0 or click_px < 0:
        raise ValueError(f"robot_accuracy_mm, click_px: must not be negative, got {robot_accuracy_mm}, {click_px}.")
    if not fps > 0:
        raise ValueError(f"fps: must be positive, got {fps}.")
    folder = Path(folder)
    rng = np.random.default_rng([seed, 101])
    eye = eye if eye is not None else Eye(seed=RESERVED_SEEDS[seed % len(RESERVED_SEEDS)])
    forceps = forceps or reserved_forceps(np.random.default_rng([seed, 103]), seed=seed % len(RESERVED_SEEDS))
    microscope = microscope or Microscope()
    if not isinstance(motion, Motion):
        duration_s = duration_s or {"sweep": 30.0, "surgeon": 18.0, "both": 45.0}.get(motion, 30.0)
        motion = Motion(forceps, eye, kind=motion, seed=seed, duration_s=duration_s)
    step = max(1, int(motion.duration_s * fps / n_frames))
    time_s = np.arange(n_frames) * step / fps
    u, visibility = np.empty((2, n_frames, 3, 2)), np.empty((2, n_frames, 3), int)
    in_glint = np.zeros((2, n_frames, 3), bool)
    landmarks = np.empty((n_frames, 3, 3))
    rig = microscope.rig(RigidTransform.identity())
    moved_at, moved_rig = n_frames, rig
    if camera_motion is not None:
        moved_at, after_from_before = camera_motion
        if not 0 < moved_at < n_frames:
            raise ValueError(f"camera_motion: the frame must lie between 1 and {n_frames - 1}, got {moved_at}.")
        moved_rig = _moved(rig, after_from_before)
    details = {
        "simulated": True,
        "seed": seed,
        "frame_step": step,
        "depth_of_field_mm": microscope.depth_of_field_mm,
        "exposure_s": microscope.exposure_s,
    }
    if microscope.inverse_distance_per_mm:
        details["inverse_distance_per_mm"] = microscope.inverse_distance_per_mm
    if camera_motion is not None:
        details["camera_moved_at_frame"] = moved_at
    with RecordingWriter(
        folder,
        name=name or folder.name,
        fps=fps,
        image_size_px=microscope.image_size_px,
        description=description,
        readout_s=microscope.readout_s,
        offset_s=offset_s,
        robot_accuracy_mm=robot_accuracy_mm,
        details=details,
        suffix=".png" if microscope.jpeg_quality is None else ".jpg",
        jpeg_quality=microscope.jpeg_quality or 90,
        overwrite=overwrite,
    ) as writer:
        for k in tqdm(range(n_frames), desc=f"Simulating {folder.name}", unit="pair", disable=progress is not True):
            pose = motion.pose(time_s[k])
            views = render_pair(
                eye, microscope, forceps=forceps, pose=pose, later=motion.later(time_s[k]),
                rig=rig if k < moved_at else moved_rig, rng=np.random.default_rng([seed, 107, k]),
            )  # fmt: skip
            writer.add(views[0].image, views[1].image, time_s[k])
            landmarks[k] = forceps.landmarks(pose)
            for side, view in enumerate(views):
                u[side, k], visibility[side, k], in_glint[side, k] = view.u, view.visibility, _in_glint(view)
            if masks:
                for side, view in zip(("left", "right"), views, strict=True):
                    path = writer.truth_folder / "masks" / side / f"{k:06d}.png"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    empty = np.zeros_like(view.tool_mask)
                    cv2.imencode(".png", np.dstack([empty, view.glint_mask, view.tool_mask]))[1].tofile(path)
            if callable(progress):
                progress()
        margin = 5
        count = int(np.ceil(time_s[-1] * _KINEMATICS_HZ)) + 1 + 2 * margin
        sample_s = (np.arange(count) - margin) / _KINEMATICS_HZ
        truth = np.array([forceps.landmarks(motion.pose(t)) for t in sample_s])
        reported = robot_from_microscope.apply(truth) + rng.normal(0, robot_accuracy_mm, truth.shape)
        reported[rng.random(count) < dropout] = np.nan
        writer.kinematics(sample_s + offset_s, reported)
        clicked = np.where(visibility[..., None] == 2, u + rng.normal(0, click_px, u.shape), np.nan)
        writer.annotations(*clicked, *np.where(visibility == 2, 2, 0))
        writer.truth(
            microscope.rig(robot_from_microscope),
            robot_from_microscope.apply(landmarks),
            *u,
            *visibility,
            surface=_in_robot(surface_grid(eye, rig.left, microscope.image_size_px), robot_from_microscope),
            in_glint=tuple(in_glint),
        )
        if camera_motion is not None:
            before = robot_from_microscope.compose(camera_motion[1].inverse())
            microscope.rig(before).save(writer.truth_folder / "moved_rig.json")
    return Recording.open(folder)


def _in_glint(view: View) -> np.ndarray:
    """(3,) bool: whether saturated light lies within `_GLINT_REACH_PX` of a landmark in view.

    Either the wet surface's mirror image of the lamp, which never covers the tool itself but may surround a tip, or a
    highlight of the metal: two of three channels at full scale, as one alone may be the colour of the light.
    """
    found = np.zeros(3, bool)
    for k in np.flatnonzero(view.visibility):
        column, row = np.round(view.u[k]).astype(int)
        near = np.s_[
            max(row - _GLINT_REACH_PX, 0) : row + _GLINT_REACH_PX + 1,
            max(column - _GLINT_REACH_PX, 0) : column + _GLINT_REACH_PX + 1,
        ]
        clipped = np.sort(view.image[near], axis=2)[..., 1] >= _CLIPPED
        found[k] = clipped.any() or view.glint_mask[near].any()
    return found


def _in_robot(surface: tuple[np.ndarray, ...], robot_from_microscope: RigidTransform) -> tuple[np.ndarray, ...]:
    x_px, y_px, x_mm = surface
    return x_px, y_px, robot_from_microscope.apply(x_mm)


def _moved(rig: StereoRig, after_from_before: RigidTransform) -> StereoRig:
    """The rig in the microscope frame of before the movement, as it stands after it."""
    motion = after_from_before.matrix
    return StereoRig(AffineCamera(rig.left.matrix @ motion), AffineCamera(rig.right.matrix @ motion))
