"""Shared by the studies of the detector's training: its variants, a small configuration, test windows, recorded scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from lib.geometry import cell_from_image
from lib.landmarks.network import HourglassConfig
from lib.training.augmentation import AUGMENTATIONS
from lib.training.evaluation import Evaluation
from lib.training.loop import PRESETS, TrainingConfig
from lib.training.samples import LabelledImage, Samples
from lib.workbench import report
from notebooks.studies.windows import TOOL, TOOL_REDUCTION, WindowSource

#: The five columns of the paper's ablation table, in its order.
ABLATION: dict[str, dict[str, int | bool]] = {
    "encoder": {"stacks": 1, "decoder": False, "skips": False, "residual": False},
    "+ decoder": {"stacks": 1, "decoder": True, "skips": False, "residual": False},
    "+ skips": {"stacks": 1, "decoder": True, "skips": True, "residual": False},
    "+ stack": {"stacks": 2, "decoder": True, "skips": True, "residual": False},
    "+ residual": {"stacks": 2, "decoder": True, "skips": True, "residual": True},
}
#: Thresholds of recorded PCK curves, fractions of the tool's length.
CURVE = (0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2)


def small_config(network: HourglassConfig, steps: int, seed: int) -> TrainingConfig:
    """The configuration of all variants; rotation and zoom are drawn with the windows, as in the paper."""
    return replace(
        PRESETS["best"],
        network=network,
        augmentation=AUGMENTATIONS["none"],
        steps=steps,
        ema=0.99,
        validate_every=max(1, steps // 2),
        seed=seed,
    )


def tool_windows(images: Sequence[LabelledImage], template: WindowSource) -> Samples:
    """One window around the tool of each full-HD image, displaced, rotated and zoomed at random as in training."""
    whole = [labelled for labelled in images if np.isfinite(labelled.u).all()]
    height, width = whole[0].image.shape[:2]
    size = (width // TOOL_REDUCTION, height // TOOL_REDUCTION)
    source = replace(
        template,
        crops=np.stack([cv2.resize(labelled.image, size, interpolation=cv2.INTER_AREA) for labelled in whole]),
        u=np.stack([cell_from_image(labelled.u, TOOL_REDUCTION) for labelled in whole]),
        visibility=np.stack([labelled.visibility for labelled in whole]),
        landmark=np.full(len(whole), TOOL),
    )
    return Samples.drawn(source, seed=1)


def record_scores(result: Evaluation) -> None:
    """Record the PCK curve and the scores of an evaluation."""
    for threshold, value in zip(CURVE, result.curve(np.array(CURVE)), strict=True):
        report.record(f"pck_{threshold:.3f}", value, "%")
    scores = result.scores
    report.record("median_px", scores.median_px, "px")
    report.record("p95_px", scores.p95_px, "px")
    report.record("nees", scores.nees, "", note="2 is right")
    report.record("coverage_95", scores.coverage_95, "%", note="95 is right")
    report.record("confidence_error", result.confidence_error, "", note="mean |confidence - fraction correct|")
    report.record("missed", scores.missed, "")
    report.record("labels", scores.labels, "")
