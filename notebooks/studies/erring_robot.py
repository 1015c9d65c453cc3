"""Recordings unlike those of the training, with errors in the robot's report, and the gain by adaptation to one of them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from lib import paths
from lib.adapt import Adaptation
from lib.calibration.offsets import tool_axes
from lib.landmarks.metrics import pck, tool_length_px
from lib.recordings import Recording
from lib.simulator.dataset import rung_design
from lib.simulator.recording import simulate
from lib.workbench import report
from notebooks import real_data


def recorded(rung: str, recording_seed: int, pairs: int) -> tuple[Recording, np.ndarray] | None:
    """The recording of a rung, and its true landmarks (n, 2, 3, 2) px; None if that of the other renderer is not at hand."""
    if rung == "other renderer":
        folder = real_data.folder("path_traced")
        if folder is None:
            return None
        frames = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["frames"]
        exact = np.array([[frame[side]["u"] for side in ("left", "right")] for frame in frames])
        return Recording.open(folder), exact
    folder = paths.CACHE / "rungs" / f"{rung}-{recording_seed}-{pairs}"
    if not folder.is_dir():
        simulate(folder, rung_design(rung, recording_seed), seed=5000 + recording_seed, n_frames=pairs, progress=False)
    recording = Recording.open(folder)
    return recording, np.stack([recording.truth.u_left, recording.truth.u_right], axis=1)


def erring(recording: Recording, rng: np.random.Generator, *, offset_mm: float, clock_ms: float, missing: float) -> Recording:
    """The recording with errors in the log: constant offsets in the tool's axes, a clock error, missing samples."""
    k = recording.kinematics
    offset = rng.normal(size=(3, 3))
    offset *= offset_mm / np.linalg.norm(offset, axis=1, keepdims=True)
    axes = tool_axes(k.x_mm)
    known = np.flatnonzero(np.isfinite(axes).all(axis=(1, 2)))  # shut jaws have no axes: take those of the nearest sample
    axes = axes[known[np.abs(np.arange(len(axes))[:, None] - known).argmin(axis=1)]]
    x = k.x_mm + np.einsum("mij,kj->mki", axes, offset)
    x[rng.random(len(x)) < missing] = np.nan
    return replace(recording, kinematics=replace(k, x_mm=x), offset_s=recording.offset_s + 1e-3 * clock_ms)


def record_gain(found: Adaptation, exact: np.ndarray, image_size_px: tuple[int, int]) -> None:
    """Record errors in the frames for judging: of the detector before and after the training, and of the labels."""
    told = exact[found.frames["judge"]].reshape(-1, 3, 2)
    inside = ((told > -0.5) & (told < np.array(image_size_px) - 0.5)).all(-1)
    length, told = tool_length_px(told), np.where(inside[..., None], told, np.nan)
    for name, u in {"before": found.seen[0].u, "after": found.seen[1].u, "labels": found.told}.items():
        u = u.reshape(-1, 3, 2)
        for threshold in (0.01, 0.05, 0.1):
            report.record(f"pck_{threshold:g}_{name}", pck(u, told, threshold, length_px=length), "%")
        error = np.linalg.norm(u - told, axis=-1)[inside]
        report.record(f"median_{name}_px", np.median(np.where(np.isfinite(error), error, np.inf)), "px")
