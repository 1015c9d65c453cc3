"""The detector's stages in training: what each learns from, how, and all of them together on a user's labelled frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from lib.landmarks import Detector
from lib.landmarks.network import HourglassConfig, OffsetConfig
from lib.landmarks.windows import direction_rad
from lib.training.augmentation import AUGMENTATIONS
from lib.training.config import PRESETS, TrainingConfig
from lib.training.error_models import fit_error_models
from lib.training.loop import Training, train
from lib.training.samples import LabelledImage, Mixed, Samples, Source
from lib.training.shards import frame_samples, validation_images, write_frames
from lib.training.windows import CloseupSource, WindowSource

__all__ = ["STAGES", "finetune", "stage_config", "stage_data"]

#: The stages in the order of their use, and the channels of the shipped networks.
STAGES = {"frame": 32, "tool": 48, "window": 96, "closeup": 32}
#: Images in a shard of labelled frames.
_SHARD = 64


def stage_config(stage: str, *, preset: str = "best", features: int | None = None) -> TrainingConfig:
    """How a stage of the shipped detector is trained.

    >>> stage_config("tool").network.features
    48
    """
    config, features = PRESETS[preset], features or STAGES[stage]
    if stage == "closeup":
        augmentation = AUGMENTATIONS["closeups"]
        return replace(config, network=OffsetConfig(features), augmentation=augmentation, batch_size=64, clip=2.0)
    if stage == "frame":
        return replace(config, network=HourglassConfig(features, depth=3), batch_size=8, ema=0.995)
    config = replace(config, network=HourglassConfig(features), augmentation=AUGMENTATIONS["windows"])
    return replace(config, ema=0.995) if stage == "tool" else replace(config, position_weight_per_px=0.04)


def stage_data(stage: str, folder: str | Path, *, closeups: str = "closeups") -> tuple[Source, Samples]:
    """Training data and validation samples of a stage, from a folder of shards; closeups from shards of kind `closeups`."""
    if stage == "frame":
        return frame_samples(folder), frame_samples(folder, validation=True)
    load = {"tool": WindowSource.load_tools, "window": WindowSource.load, "closeup": CloseupSource.load}[stage]
    source = load(folder, kind=closeups) if stage == "closeup" else load(folder)
    if stage == "window":  # the simulator varies the magnification itself
        source = replace(source, zoom=(0.9, 1.1))
    return source, Samples.drawn(load(folder, validation=True))


def finetune(
    detector: Detector,
    images: Iterable[LabelledImage],
    held_out: Iterable[LabelledImage],
    folder: str | Path,
    *,
    simulated: str | Path | None = None,
    steps: int = 500,
    seed: int = 0,
    progress: bool = True,
) -> Detector:
    """Train all stages of a detector further on labelled frames, then fit its error models on held-out ones.

    Args:
        images, held_out: Full-resolution images of one size; images without a labelled base and tip are left out.
            Consecutive frames are alike, so hold out whole recordings, or the end of one.
        folder: Keeps the frames as shards and the checkpoints, from which the same call continues.
        simulated: Folder of `generate`'s shards; half of what is drawn then comes from there, so that the networks do
            not forget tools and eyes that the labelled frames do not show.

    Raises:
        ValueError: If there is no usable image, or fewer than 20 landmarks are found in the held-out ones.
    """
    data = Path(folder) / "data"
    data.mkdir(parents=True, exist_ok=True)
    for kind, part in (("training", images), ("validation", held_out)):
        usable = [labelled for labelled in part if np.isfinite(direction_rad(labelled.u[None])).all()]
        if not usable:
            raise ValueError(f"{kind} images: none has a labelled base and tip; label some.")
        for i in range(0, len(usable), _SHARD):
            write_frames(data / f"{kind}_{i // _SHARD:04d}.npz", usable[i : i + _SHARD], keep_frames=kind == "validation")
    networks = {}
    for stage, network in detector.networks.items():
        source, validation = stage_data(stage, data, closeups="training")
        if simulated is not None:
            source = Mixed(source, stage_data(stage, simulated)[0])
        config = replace(stage_config(stage), network=network.config, steps=steps, learning_rate=3e-4, seed=seed)
        config = replace(config, batch_size=min(config.batch_size, len(source)), validate_every=max(1, steps // 5))
        start = Training(network, [], {"shipped": detector.metadata.get("commit")})
        done = train(config, source, validation, Path(folder) / stage, initial=start, progress=progress)
        networks[f"{stage}_network"] = done.network
    fitted_on = [*validation_images(data), *(validation_images(simulated) if simulated is not None else ())]
    return fit_error_models(replace(detector, **networks), fitted_on, progress=progress)
