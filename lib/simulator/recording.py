"""Whole simulated recordings with ground truth, in the format of `lib.recordings`."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from lib.geometry import RigidTransform, check
from lib.recordings import Recording, RecordingWriter, Truth
from lib.simulator.eye import Eye, Scene
from lib.simulator.forceps import Forceps
from lib.simulator.motion import DURATIONS_S, Motion
from lib.simulator.population import RESERVED_SEEDS, reserved_forceps
from lib.simulator.render import View, render_pair
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, Microscope
from lib.simulator.window import surface_grid

_KINEMATICS_HZ, _KINEMATICS_MARGIN = 100.0, 5  # samples before the first and after the last frame
_GLINT_REACH_PX = 3  # a detector looks at a landmark's surroundings, not at one pixel


@dataclass(frozen=True)
class Design:
    """The content of a simulated recording, its microscope, and the errors of robot and annotator.

    Attributes:
        eye, forceps: None = chosen by the recording's seed, from designs that no training sees.
        motion, duration_s: "sweep" (calibration), "surgeon" or "both"; None = 30, 18 or 45 s.
        robot_accuracy_mm, click_px: Standard deviations of kinematics and annotations, per coordinate.
        offset_s, dropout: t_robot = t_video + offset_s; and the share of kinematic samples without values.
    """

    eye: Scene | None = None
    forceps: Forceps | None = None
    microscope: Microscope = field(default_factory=Microscope)
    motion: str = "both"
    duration_s: float | None = None
    robot_accuracy_mm: float = 0.010
    offset_s: float = 0.0
    dropout: float = 0.0
    click_px: float = 1.0

    def __post_init__(self) -> None:
        check(self, "robot_accuracy_mm click_px", lambda v: v >= 0, "must not be negative")
        check(self, "dropout", lambda v: 0 <= v < 1, "a share, at least 0 and below 1")


def simulate(
    folder: str | Path, design: Design | None = None, seed: int = 0, n_frames: int = 40, *, name: str | None = None,
    description: str = "", progress: bool = True, overwrite: bool = False,
) -> Recording:  # fmt: skip
    """Simulate a recording and write it to `folder`, which appears whole or not at all.  Equal arguments give equal files.

    The frames are spread over the motion: every k-th frame of the video is kept, with its time in frames.csv.

    `name` (None = the folder's name) and `description` are written to recording.toml; `progress` shows a bar.  Raises
    FileExistsError if the folder exists and `overwrite` is False.

    >>> import tempfile
    >>> microscope = Microscope(pixels_per_mm=(4.0, 4.0), image_size_px=(80, 60))
    >>> design = Design(Eye(texture_px=64), microscope=microscope, motion="sweep")
    >>> made = simulate(tempfile.mkdtemp() + "/mine", design, n_frames=1, progress=False)
    >>> made.frames[0].left.shape, made.truth.landmarks_mm.shape
    ((60, 80, 3), (1, 3, 3))
    """
    if n_frames < 1:
        raise ValueError(f"n_frames: must be at least 1, got {n_frames}.")
    folder, design = Path(folder), design or Design()
    microscope = design.microscope
    eye = design.eye if design.eye is not None else Eye(seed=RESERVED_SEEDS[seed % len(RESERVED_SEEDS)])
    forceps = design.forceps or reserved_forceps(np.random.default_rng([seed, 103]), seed % len(RESERVED_SEEDS))
    duration_s = DURATIONS_S.get(design.motion, 30.0) if design.duration_s is None else design.duration_s
    motion = Motion(forceps, eye, kind=design.motion, seed=seed, duration_s=duration_s)
    step = max(1, int(motion.duration_s * microscope.fps / n_frames))
    time_s = np.arange(n_frames) * step / microscope.fps
    if time_s[-1] > motion.duration_s:
        raise ValueError(f"n_frames: {n_frames} at {microscope.fps:g} Hz last longer than the motion's {duration_s:g} s.")
    details = {"simulated": True, "seed": seed, "frame_step": step}
    details |= {"depth_of_field_mm": microscope.depth_of_field_mm, "exposure_s": microscope.exposure_s}
    if microscope.inverse_distance_per_mm:
        details["inverse_distance_per_mm"] = microscope.inverse_distance_per_mm
    u, visibility = np.empty((2, n_frames, 3, 2)), np.empty((2, n_frames, 3), int)
    in_glint, landmarks = np.zeros((2, n_frames, 3), bool), np.empty((n_frames, 3, 3))
    with RecordingWriter(
        folder, name=name or folder.name, description=description, details=details, overwrite=overwrite,
        fps=microscope.fps, image_size_px=microscope.image_size_px, readout_s=microscope.readout_s,
        offset_s=design.offset_s, robot_accuracy_mm=design.robot_accuracy_mm,
        suffix=".png" if microscope.jpeg_quality is None else ".jpg", jpeg_quality=microscope.jpeg_quality or 90,
    ) as writer:  # fmt: skip
        for k in tqdm(range(n_frames), desc=f"Simulating {folder.name}", unit="pair", disable=not progress):
            pose, noise = motion.pose(time_s[k]), np.random.default_rng([seed, 107, k])
            later = motion.pose(time_s[k] + 1e-3), 1e-3
            views = render_pair(eye, microscope, forceps=forceps, pose=pose, later=later, rng=noise)
            writer.add(views[0].image, views[1].image, time_s[k])
            landmarks[k] = forceps.landmarks(pose)
            for side, view in enumerate(views):
                u[side, k], visibility[side, k], in_glint[side, k] = view.u, view.visibility, _in_glint(view)
        rng, to_robot = np.random.default_rng([seed, 101]), ROBOT_FROM_MICROSCOPE.apply
        count = int(np.ceil(time_s[-1] * _KINEMATICS_HZ)) + 1 + 2 * _KINEMATICS_MARGIN
        sample_s = (np.arange(count) - _KINEMATICS_MARGIN) / _KINEMATICS_HZ
        reported = to_robot(np.array([forceps.landmarks(motion.pose(t)) for t in sample_s]))
        reported += rng.normal(0, design.robot_accuracy_mm, reported.shape)
        reported[rng.random(count) < design.dropout] = np.nan
        writer.kinematics(sample_s + design.offset_s, reported)
        clicked = np.where(visibility[..., None] == 2, u + rng.normal(0, design.click_px, u.shape), np.nan)
        writer.annotations(*clicked, *np.where(visibility == 2, 2, 0))
        x_px, y_px, surface_mm = surface_grid(eye, microscope.rig(RigidTransform.identity()).left, microscope.image_size_px)
        truth = Truth(microscope.rig(), to_robot(landmarks), *u, *visibility, writer.folder / "truth", *in_glint)
        truth.write((x_px, y_px, to_robot(surface_mm)))
    return Recording.open(folder)


def _in_glint(view: View) -> np.ndarray:
    """(3,) bool: True if a glint, or a highlight of the metal, lies within `_GLINT_REACH_PX` of a landmark in view."""
    found = np.zeros(3, bool)
    for k in np.flatnonzero(view.visibility):
        column, row = (slice(max(c - _GLINT_REACH_PX, 0), c + _GLINT_REACH_PX + 1) for c in np.round(view.u[k]).astype(int))
        clipped = np.sort(view.image[row, column], axis=2)[..., 1] >= 250  # two channels: one may be the light's colour
        found[k] = clipped.any() or view.glint_mask[row, column].any()
    return found
