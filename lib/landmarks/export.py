"""The detector for other programs: each stage as ONNX with its decoding and calibration inside, checked against torch.

A stage takes its own input, RGB in [0, 1] of shape (n, 3, h, w), and gives what `Landmarks` holds: u (n, 3, 2) px, covariance
(n, 3, 2, 2) px^2 and confidence (n, 3); those of the first stage in pixels of the unreduced frame.  The stages for
landmarks see a window or a closeup of each and their caller takes that landmark's row.  ``closeup`` corrects what the windows
are sure of (the windows' confidence is kept), ``tracking`` follows what was found in the frame before: the same closeups,
believed otherwise.
"""

from __future__ import annotations

import importlib.util
import os
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from lib import paths
from lib.landmarks.detector import CLOSE, MISSING_BELOW, Detector
from lib.landmarks.engines import LastOutput, openvino
from lib.landmarks.error_model import ErrorModel, closeup_peaks, corrected, covariance_and_confidence
from lib.landmarks.heatmaps import Peaks, decode
from lib.landmarks.images import as_tensor
from lib.landmarks.windows import CLOSEUP_REACH_PX, CLOSEUP_ZOOM, expected_in_closeup
from lib.recordings import Recording

__all__ = [
    "PARITY_CONFIDENCE",
    "PARITY_COVARIANCE",
    "PARITY_PX",
    "StageWithDecoding",
    "export",
    "export_shipped",
    "run_onnx",
]

#: Largest differences from torch that an exported stage may show.
PARITY_PX = 0.01
PARITY_CONFIDENCE = 0.001
#: Share of a landmark's variance.
PARITY_COVARIANCE = 0.02
OPSET = 18


class StageWithDecoding(nn.Module):
    """Images to landmarks in one graph: network, decoder, and the calibration of covariance and confidence.

    Attributes
    ----------
    scale:
        Image pixels per pixel of the stage's input.
    """

    def __init__(self, detector: Detector, stage: str):
        super().__init__()
        self.closeup = stage in CLOSE
        network = detector.networks["closeup" if self.closeup else stage]
        self.network = LastOutput(network, mirror=detector.mirror and stage == "window")
        self.stride, self.method = None if self.closeup else network.stride, detector.method
        self.scale = detector.reduction if stage == "frame" else 1
        fit = detector.error_models.get(stage, ErrorModel())
        self.register_buffer("log_variance", torch.tensor(fit.coefficients, dtype=torch.float32))
        self.register_buffer("logit", torch.tensor(fit.logit))
        self.register_buffer("gain", torch.tensor(fit.gain))
        self.register_buffer("bias", torch.tensor(fit.bias))
        if self.closeup:
            expected = expected_in_closeup(network.config.size_px, np.arange(3))
            self.register_buffer("expected", torch.tensor(expected, dtype=torch.float32))
            self.register_buffer("reach", CLOSEUP_REACH_PX * torch.tensor(CLOSEUP_ZOOM))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen = self.network(images)
        if self.closeup:
            one = closeup_peaks(
                seen, images.shape[-1]
            )  # believed in three ways, as which landmark it shows is not known here
            parts = (
                one.u.repeat(1, 3, 1),
                one.value.repeat(1, 3),
                one.width.repeat(1, 3),
                one.covariance.repeat(1, 3, 1, 1),
            )
            peaks = corrected(Peaks(*parts), self.expected, self.gain, self.bias, self.reach)
        else:
            peaks = decode(seen, self.stride, method=self.method)
        covariance, confidence = covariance_and_confidence(peaks, self.scale, self.log_variance, self.logit)
        u = peaks.u * self.scale + (self.scale - 1) / 2
        return u, covariance, confidence


def export(detector: Detector, folder: str | Path, examples: np.ndarray) -> dict[str, tuple[Path, float]]:
    """Write every stage as ``STAGE.onnx`` into `folder`, if it agrees with torch.

    Parameters
    ----------
    examples:
        Frames (n, h, w, 3) uint8 with the tool in view: what is compared, and the size of frame that the first stage takes.

    Returns
    -------
    File of each stage, and its largest difference from torch in px, over landmarks that torch finds.

    Raises
    ------
    ValueError
        If a stage differs by more than `PARITY_PX`, `PARITY_CONFIDENCE` or `PARITY_COVARIANCE` (its file is not written),
        nothing is found in `examples`, or a package is missing.
    """
    for package in ("onnx", "openvino"):  # one writes the files, the other runs them for the comparison
        if not importlib.util.find_spec(package):
            raise ValueError(
                f"export: needs the package {package}, which is not installed here; `pip install {package}`."
            )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    detector = replace(detector, engine="torch")
    rough, result = detector(examples).u, {}
    for stage in detector.stages:
        images = detector.reduced(examples) if stage == "frame" else detector.windows(examples, rough, stage)[0]
        if not len(images):
            raise ValueError("examples: no tool was found in them, so nothing can be compared; give other frames.")
        x = as_tensor(images).contiguous()
        module = StageWithDecoding(detector, stage).eval()
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / f"{stage}.onnx"
            _write(module, x, path)
            u, covariance, confidence = run_onnx(path, x.numpy())
            with torch.inference_mode():
                expected, expected_covariance, expected_confidence = (part.numpy() for part in module(x))
            seen = expected_confidence >= MISSING_BELOW
            if not seen.any():
                raise ValueError(f"examples: the stage {stage!r} finds nothing in them; give other frames.")
            difference = float(np.abs(u - expected)[seen].max())
            variance = np.trace(expected_covariance, axis1=-2, axis2=-1)[..., None, None]
            for largest, limit, unit in (
                (difference, PARITY_PX, "px"),
                (
                    float((np.abs(covariance - expected_covariance) / variance)[seen].max()),
                    PARITY_COVARIANCE,
                    "of variance",
                ),
                (float(np.abs(confidence - expected_confidence).max()), PARITY_CONFIDENCE, "of confidence"),
            ):
                if not largest <= limit:
                    raise ValueError(
                        f"{stage}: ONNX and torch differ by {largest:.3g} {unit}, more than {limit}; not exported."
                    )
            partial = folder / f"{stage}.onnx.partial"
            partial.write_bytes(path.read_bytes())
            os.replace(partial, folder / f"{stage}.onnx")
        result[stage] = folder / f"{stage}.onnx", difference
    return result


def export_shipped(weights: str | Path | None, folder: str | Path) -> dict[str, tuple[Path, float]]:
    """`export` of a weights file, compared on frames of the recording that ships."""
    frames = Recording.open(paths.SHIPPED_RECORDING).frames
    chosen = [frames[i] for i in (0, len(frames) // 2)]
    return export(Detector.load(weights), folder, np.stack([image for f in chosen for image in (f.left, f.right)]))


def _write(module: nn.Module, example: Tensor, path: Path) -> None:
    names = ["u", "covariance", "confidence"]
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # sizes are fixed by tracing, as they shall be
        torch.onnx.export(
            module, (example,), str(path), dynamo=False, opset_version=OPSET, input_names=["images"], output_names=names,
            dynamic_axes={name: {0: "n"} for name in ["images", *names]},
        )  # fmt: skip


def run_onnx(path: str | Path, images: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, covariance and confidence that an exported stage gives for images (n, 3, h, w) in [0, 1], in float32."""
    ov = openvino()
    model = ov.Core().compile_model(ov.Core().read_model(str(path)), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    found = model(images)
    return found["u"], found["covariance"], found["confidence"]
