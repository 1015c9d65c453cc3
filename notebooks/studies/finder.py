"""Real frames without kinematics (Retinal Microsurgery): the finder fine-tuned on half a sequence, and the shipped detector.

The finder is the detector's first stage.  It sees the real frames at full resolution, where the tool is as long as in its
simulated frames: 20 to 45 px.  Notebook 02 trains it for a moment, ``studies/real_frames`` for longer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from lib.geometry import cell_from_image, image_from_cell
from lib.landmarks import Detector
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.metrics import pck, tool_length_px
from lib.training.augmentation import Augmentation
from lib.training.config import PRESETS, TrainingConfig
from lib.training.evaluation import Evaluation, evaluate
from lib.training.loop import Training, train
from lib.training.samples import LabelledImage, Mixed, Samples, Source
from notebooks.studies.retinal import MonocularSequence

__all__ = [
    "Crops",
    "evaluate_on_sequence",
    "finder_alone",
    "label_repeatability",
    "quick_config",
    "real_config",
    "real_samples",
    "simulated_to_real",
    "train_on_first_half",
]

#: Of the crops that training sees.
CROP_PX = 128
#: Magnification of real frames for the whole detector, which takes tools of any length.
ZOOM = 1.0
#: Every detection counts: on real frames confidence is not calibrated.
_ALWAYS = ErrorModel(logit=(9.0, 0.0, 0.0, 0.0))


def real_samples(sequence: MonocularSequence, first: int, end: int) -> Samples:
    """Frames `first` to `end` - 1 of a sequence in memory."""
    u = sequence.u[first:end]
    return Samples(np.stack([sequence.image(i) for i in range(first, end)]), u, _visibility(u))


@dataclass(frozen=True)
class Crops(Source):
    """Squares of `size` px out of larger images, three of four round the tool and the others anywhere."""

    samples: Samples
    size: int = CROP_PX

    def __post_init__(self) -> None:
        if min(self.samples.images.shape[1:3]) < self.size:
            raise ValueError(f"size: {self.size} px do not fit images of {self.samples.images.shape[2:0:-1]} px.")

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        image, u, visibility = self.samples.draw(index, rng)
        h, w = image.shape[:2]
        known = np.isfinite(u).all(axis=1)
        near = rng.random() < 0.75 and known.any()
        shift = rng.uniform(-0.4, 0.4, 2) * self.size
        centre = u[known].mean(axis=0) + shift if near else rng.uniform((0, 0), (w, h))
        x, y = np.clip(np.round(centre - self.size / 2), 0, (w - self.size, h - self.size)).astype(int)
        return image[y : y + self.size, x : x + self.size], u - (x, y), visibility


def real_config(steps: int, *, batch: int = 12, seed: int = 0) -> TrainingConfig:
    """How the finder is fine-tuned."""
    return replace(
        PRESETS["best"],
        augmentation=Augmentation(30.0, (0.65, 1.3), photometric=0.7),
        steps=steps,
        batch_size=batch,
        learning_rate=1e-3,
        ema=0.99,
        validate_every=max(1, steps // 3),
        seed=seed,
    )


def quick_config(steps: int, *, seed: int = 0) -> TrainingConfig:
    """For a minute or less, on real crops alone: small batches, mild augmentation."""
    return replace(
        real_config(steps, batch=6, seed=seed),
        augmentation=Augmentation(15.0, (0.85, 1.15)),
        learning_rate=2e-3,
        ema=0.97,
        validate_every=steps,
    )


def train_on_first_half(
    sequence: MonocularSequence,
    detector: Detector,
    simulated: Samples | None,
    config: TrainingConfig,
    *,
    folder: Path | None = None,
    max_seconds: float | None = None,
    progress: bool = False,
) -> Training:
    """The detector's first stage fine-tuned on crops of the first half of a sequence and of simulated frames.

    Parameters
    ----------
    simulated:
        Whole frames at the finder's resolution, half of what is drawn; None = real frames alone.
    config:
        `real_config` or `quick_config`.
    folder:
        Keeps checkpoints, from which the same call goes on.
    """
    real = Crops(real_samples(sequence, 0, len(sequence) // 2))
    # These are crops of training frames.  They only fill the log; nothing is chosen by them.
    few = Samples.drawn(Crops(_every(real.samples, 1 + len(real) // 25)))
    initial = Training(detector.frame_network, [], {"shipped": detector.metadata.get("commit")})
    config = replace(config, network=detector.frame_network.config)
    source = Mixed(real, Crops(simulated)) if simulated is not None else real
    return train(config, source, few, folder, initial=initial, max_seconds=max_seconds, progress=progress)


def finder_alone(detector: Detector, training: Training | None = None) -> Detector:
    """The detector's first stage alone, at full resolution; with a training's weights where one is given."""
    return replace(
        detector,
        frame_network=training.network if training else detector.frame_network,
        tool_network=None,
        window_network=None,
        closeup_network=None,
        frame_px=None,
        mirror=False,
        error_models={"frame": _ALWAYS},
    )


def evaluate_on_sequence(
    detector: Detector, sequence: MonocularSequence, *, second_half: bool = False, every: int = 1
) -> Evaluation:
    """A detector on every `every`-th labelled frame of a sequence, or of its second half.

    Consecutive frames are alike, so halves in time are the honest split.
    """
    return evaluate(detector, _frames(sequence, len(sequence) // 2 if second_half else 0, every))


def label_repeatability(sequence: MonocularSequence, threshold: float = 0.2) -> float:
    """PCK in percent that a detector without error would reach on the second half, since clicks jitter.

    Each click is compared with the mean of those one frame before and after.  If all err alike that difference has 3/2 of
    one click's variance, and is divided by the root of that.  Uneven motion of the tool adds to it.
    """
    middle = len(sequence) // 2
    u, number = sequence.u[middle:], np.asarray(sequence.frame_numbers)[middle:]
    consecutive = (np.diff(number[:-1]) == 1) & (np.diff(number[1:]) == 1)
    click, between = u[1:-1], (u[:-2] + u[2:]) / 2
    compared = np.where(consecutive[:, None, None] & np.isfinite(between), click, np.nan)
    return float(pck(click + (between - click) / np.sqrt(1.5), compared, threshold, length_px=tool_length_px(click)))


def simulated_to_real(
    detector: Detector, sequence: MonocularSequence, *, every: int = 8, zoom: float = ZOOM
) -> Evaluation:
    """The shipped detector on real frames, magnified by `zoom` to the tool's size in its own recordings.

    It has seen no real frame.  The result is in the frames' own pixels.
    """
    detector = replace(detector, error_models={stage: _always(fit) for stage, fit in detector.error_models.items()})
    size = tuple(round(zoom * s) for s in sequence.image_size_px)
    frames = (
        part._replace(image=cv2.resize(part.image, size, interpolation=cv2.INTER_CUBIC), u=image_from_cell(part.u, zoom))
        for part in _frames(sequence, 0, every)
    )
    found = evaluate(detector, frames)
    landmarks = replace(
        found.landmarks,
        u=cell_from_image(found.landmarks.u, zoom),
        covariance=found.landmarks.covariance / zoom**2,
    )
    return replace(
        found, landmarks=landmarks, u_true=cell_from_image(found.u_true, zoom), length_px=found.length_px / zoom
    )


def _always(fit: ErrorModel) -> ErrorModel:
    return replace(fit, logit=_ALWAYS.logit)


def _every(samples: Samples, n: int) -> Samples:
    return Samples(samples.images[::n], samples.u[::n], samples.visibility[::n])


def _visibility(u: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(u).all(axis=-1), 2, 0)


def _frames(sequence: MonocularSequence, first: int, every: int) -> Iterator[LabelledImage]:
    u = sequence.u
    for i in range(first, len(sequence), every):
        if np.isfinite(u[i]).any():
            name = f"{sequence.name} {sequence.frame_numbers[i]}"
            yield LabelledImage(name, sequence.image(i), u[i], _visibility(u[i]))
