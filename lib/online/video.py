"""A video of the online system: both images with landmarks, distances over time with their sd, states, times of stages."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from lib.correspondences import LANDMARK_COLOURS, LANDMARKS
from lib.online.result import STAGES, STATES, FrameResult
from lib.recordings import StereoFrame
from lib.trust.check import overlay

_SIZE = (1280, 720)
_STEPS_MM = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # between the lines of the curve
_LIGHTS = dict(zip(STATES, ((120, 120, 120), (0, 170, 80), (90, 150, 230), (40, 40, 40), (240, 190, 60), (220, 60, 50)),
                   strict=True))  # fmt: skip


class Dashboard:
    """Draws each result as one image (720, 1280, 3) uint8 RGB, with a curve of the distances in the newest `frames`."""

    def __init__(self, frames: int = 250) -> None:
        self._past: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=frames)  # distances and their standard deviations

    def draw(self, left: np.ndarray, right: np.ndarray, result: FrameResult) -> np.ndarray:
        """The image for one frame."""
        page = np.full((_SIZE[1], _SIZE[0], 3), 250, np.uint8)
        u = np.stack([result.landmarks.u_left, result.landmarks.u_right])
        views = overlay(StereoFrame(left, right, result.time_s), u, None, min(637, 360 * left.shape[1] // left.shape[0]))
        page[: views.shape[0], : views.shape[1]] = views
        for i, (state, colour) in enumerate(_LIGHTS.items()):
            on, at = state == result.state, (30 + 150 * i, 390)
            cv2.circle(page, at, 10, colour if on else (215, 215, 215), -1, cv2.LINE_AA)
            _text(page, state, (at[0] + 16, at[1] + 5), (0, 0, 0) if on else (160, 160, 160))
        _text(page, f"{result.time_s:8.2f} s  {result.cause}"[:44], (930, 395))
        self._past.append((result.distance_mm, result.distance_sd_mm))
        self._curve(page[420:, :860])
        self._times(page[420:, 880:], result)
        return page

    def _curve(self, part: np.ndarray) -> None:
        past = np.array(self._past)  # (n, 2, 3)
        top = max(float(np.nanmax(past[:, 0], initial=0.5, where=np.isfinite(past[:, 0]))), 0.5) * 1.15
        height, width = part.shape[0] - 40, part.shape[1] - 70

        def place(i: float, mm: float) -> tuple[int, int]:
            row = np.clip(10 + height * (1 - (mm + 0.1) / (top + 0.1)), 0, height + 20)
            return int(60 + i * width / self._past.maxlen), int(row)

        step = next((step for step in _STEPS_MM if top <= 5 * step), top)
        for mm in np.arange(0, top, step):
            cv2.line(part, place(0, mm), place(self._past.maxlen, mm), (225, 225, 225), 1)
            _text(part, f"{mm:.1f}", (15, place(0, mm)[1] + 4))
        for k, name in enumerate(LANDMARKS):
            for i, (d, sd) in enumerate(past[:, :, k]):
                if np.isfinite(d) and np.isfinite(sd):
                    pale = tuple(int(200 + 0.2 * c) for c in LANDMARK_COLOURS[name])
                    cv2.line(part, place(i, d - 2 * sd), place(i, d + 2 * sd), pale, 2)
                    cv2.circle(part, place(i, d), 2, LANDMARK_COLOURS[name], -1, cv2.LINE_AA)
            _text(part, name, (60 + 90 * k, part.shape[0] - 8), tuple(0.6 * c for c in LANDMARK_COLOURS[name]))
        _text(part, f"mm to the retina, with 2 sd; the last {len(past)} frames", (360, part.shape[0] - 8))

    def _times(self, part: np.ndarray, result: FrameResult) -> None:
        for i, stage in enumerate(STAGES):
            spent = 1e3 * result.seconds.get(stage, 0.0)
            y = 22 + 26 * i
            cv2.rectangle(part, (95, y - 11), (95 + int(min(spent, 250.0)), y + 2), (150, 190, 220), -1)
            _text(part, stage, (0, y))
            _text(part, f"{spent:.0f} ms", (100, y))
        _text(part, f"surfaces dropped: {result.dropped}", (0, 22 + 26 * len(STAGES)))
        for i, why in enumerate(f"{name}: {text}" for name, text in list(result.failures.items())[:3]):
            _text(part, why[:58], (0, 48 + 26 * (len(STAGES) + i)), (190, 40, 30))


def _text(image: np.ndarray, text: str, at: tuple[int, int], colour: tuple[int, ...] = (60, 60, 60)) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)


@contextmanager
def video_file(path: str | Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Yields a function that adds an image of `Dashboard.draw` to an MP4 file; a ValueError if it cannot be written."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), fps, _SIZE)
    if not writer.isOpened():
        raise ValueError(f"{path}: the video cannot be written; does the folder exist, does it end with .mp4?")
    try:
        yield lambda page: writer.write(cv2.cvtColor(page, cv2.COLOR_RGB2BGR))
    finally:
        writer.release()
