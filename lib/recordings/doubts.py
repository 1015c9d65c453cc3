"""What makes a recording suspicious though it can be read: clocks, gaps, jumps."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

__all__ = ["Doubt", "doubts"]

#: A log is that many times longer than its video only by intent, or if the times of the frames are missing.
_LONGER = 5.0
_COVERED = 0.75  # share of frames with a position, below which log and video do not fit
_JUMP_MM = 20.0  # from one sample to the next; no surgical robot moves so
_SLOW_S = 0.5  # between samples; robots report 10 to 1000 times a second


class Doubt(NamedTuple):
    """A name in snake case, plain words with the numbers, and what to do."""

    name: str
    text: str
    cure: str


def doubts(frame_s: np.ndarray, fps: float, log_s: np.ndarray, x_mm: np.ndarray, reported: np.ndarray) -> Iterator[Doubt]:
    """Judge times of the frames (n,) on the robot's clock, the log's times (m,), its positions (m, k, 3), and in which frames
    (n,) the robot reports any landmark.
    """
    span, logged = float(np.ptp(frame_s)), float(np.ptp(log_s))
    uniform = np.allclose(np.diff(frame_s) * fps, 1.0, rtol=1e-3)
    if uniform and logged > _LONGER * (span + 1.0 / fps) and logged > 2.0:
        text = f"{len(frame_s)} frames at {fps:g} fps last {span:.1f} s, but the robot's log {logged:.1f} s."
        yield Doubt("frame_times", text, "If frames were left out, write their times to frames.csv (frame, time_s).")
    if reported.mean() < _COVERED:
        text = f"The robot reports a position in {reported.sum()} of {len(frame_s)} frames; log and video hardly overlap."
        yield Doubt("little_overlap", text, "Check offset_s and the time_s columns; export the log of the whole video.")
    if len(log_s) < 2:
        return
    step = np.diff(log_s)
    if np.median(step) > _SLOW_S:
        text = f"The robot's log has a sample every {np.median(step):.3g} s."
        yield Doubt("slow_log", text, "Is time_s in milliseconds? Give seconds, and ten samples a second or more.")
    jump = np.nan_to_num(np.linalg.norm(np.diff(x_mm, axis=0), axis=2)).max(axis=1)
    if (jump > _JUMP_MM).any():
        k = int(jump.argmax())
        text = f"In kinematics.csv a landmark jumps by {jump[k]:.0f} mm at {log_s[k + 1]:.3f} s (line {k + 3})."
        yield Doubt("jump", text, "Leave the cells of a wrong sample empty.")
