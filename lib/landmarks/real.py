"""Real frames without kinematics: a small whole-frame detector trained on half a sequence, and the simulated one on it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from lib.geometry import cell_from_image
from lib.landmarks.augmentation import Augmentation
from lib.landmarks.evaluation import Evaluation, evaluate
from lib.landmarks.inference import Calibration, Detector
from lib.landmarks.network import HourglassConfig
from lib.landmarks.training import PRESETS, Samples, train
from lib.recordings import MonocularSequence

__all__ = ["detector_of_first_half", "evaluate_on_sequence", "simulated_to_real", "train_on_sequence"]

#: The networks see these frames reduced by this: the tool is then 14 to 32 px long.
REDUCTION = 2
#: Every detection counts: a network trained for seconds has no calibrated confidence.
_ALWAYS = Calibration(logit=(9.0, 0.0, 0.0, 0.0))


def _visibility(u: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(u).all(axis=-1), 2, 0)


def detector_of_first_half(
    sequence: MonocularSequence, *, steps: int = 150, max_seconds: float | None = None, seed: int = 0
) -> Detector:
    """A small whole-frame detector trained on the first half of a sequence; the labels are clicks."""
    half = len(sequence) // 2
    images = np.stack([_reduce(sequence.image(i)) for i in range(half)])
    u = cell_from_image(sequence.u[:half], REDUCTION)
    samples = Samples(images, u, _visibility(u))
    config = replace(
        PRESETS["best"],
        network=HourglassConfig(24, 1, 4),
        augmentation=Augmentation(20.0, (0.85, 1.15), shift=0.1, photometric=0.3),
        steps=steps,
        batch_size=4,
        learning_rate=4e-3,
        ema=0.95,
        validate_every=steps,
        seed=seed,
    )
    # The few frames that "validate" only fill the log; nothing is chosen by them.
    few = Samples(images[-4:], u[-4:], _visibility(u[-4:])) if np.isfinite(u[-4:]).any() else samples
    trained = train(config, samples, few, max_seconds=max_seconds, progress=False)
    return Detector(trained.network, REDUCTION, calibration={"frame": _ALWAYS})


def evaluate_on_sequence(
    detector: Detector, sequence: MonocularSequence, *, second_half: bool = False, every: int = 1
) -> Evaluation:
    """A detector on every `every`-th labelled frame of a sequence, or of its second half."""
    return evaluate(detector, _frames(sequence, len(sequence) // 2 if second_half else 0, every))


def train_on_sequence(
    sequence: MonocularSequence,
    *,
    steps: int = 150,
    max_seconds: float | None = None,
    every: int = 3,
    seed: int = 0,
) -> Evaluation:
    """Train on the first half of a sequence, test on every `every`-th frame of the second.

    Consecutive frames are alike, so halves in time are the honest split.
    """
    detector = detector_of_first_half(sequence, steps=steps, max_seconds=max_seconds, seed=seed)
    return evaluate_on_sequence(detector, sequence, second_half=True, every=every)


def simulated_to_real(
    detector: Detector, sequence: MonocularSequence, *, every: int = 8, zoom: float = 3.0
) -> Evaluation:
    """The shipped detector on real frames, magnified by `zoom` to the tool's size in its own recordings.

    It has seen no real frame.  What it misses counts as wrong.
    """
    size = tuple(round(zoom * s) for s in sequence.image_size_px)
    frames = (
        (name, cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), zoom * u + (zoom - 1) / 2, visibility)
        for name, image, u, visibility in _frames(sequence, 0, every)
    )
    return evaluate(detector, frames)


def _reduce(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, None, fx=1 / REDUCTION, fy=1 / REDUCTION, interpolation=cv2.INTER_AREA)


def _frames(sequence: MonocularSequence, first: int, every: int):
    for i in range(first, len(sequence), every):
        if np.isfinite(sequence.u[i]).any():
            yield (
                f"{sequence.name} {sequence.frame_numbers[i]}",
                sequence.image(i),
                sequence.u[i],
                _visibility(sequence.u[i]),
            )
