"""The detector for other programs: each stage as ONNX with its decoding and error model inside, checked against torch.

A stage takes its own input, RGB in [0, 1] of shape (n, 3, h, w).  It returns the arrays of `Landmarks`: u (n, 3, 2) px,
covariance (n, 3, 2, 2) px^2 and confidence (n, 3).  The first stage returns them in pixels of the frame before it was
resized.  All other stages but ``tracking`` also take ``rough_u`` (n, 3, 2), the landmarks of the previous stage in pixels of
their own input, and ``rough_confidence`` (n, 3).  ``again`` is the second look of ``tool``.  The stages ``closeup``,
``closer`` and ``tracking`` see a window of one landmark; of their output use only the row of that landmark.  ``closeup``
corrects the landmarks of the previous stage unless it is unsure, ``closer`` those that ``closeup`` moved far
(`windows.moved_far`), ``tracking`` those of the previous frame.  A closeup's confidence is 0 if its landmark lies beyond its
reach, and unsure below 0.05.  Stages that share a network differ in their error models.
"""

import importlib.util
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from lib import files, paths
from lib.landmarks.detector import CLOSE, MIRRORED, MISSING_BELOW, Detector
from lib.landmarks.engines import LastOutput, openvino
from lib.landmarks.error_model import ErrorModel, Rough, closeup_peaks, corrected, covariance_and_confidence
from lib.landmarks.heatmaps import Peaks, decode
from lib.landmarks.network import as_tensor
from lib.landmarks.windows import map_points
from lib.recordings import Recording

#: Largest allowed differences between an exported stage and torch, by unit.
LARGEST = {"px": 0.01, "of variance": 0.02, "of confidence": 0.001}


class StageWithDecoding(nn.Module):
    """One stage of a detector from images to landmarks in one graph: network, decoder, error model."""

    def __init__(self, detector: Detector, stage: str, stride: np.ndarray):
        super().__init__()
        network = detector.network_of(stage)
        self.network = LastOutput(network, mirror=stage == MIRRORED)
        self.config, self.closeup, self.method = network.config, stage in CLOSE, detector.method
        self.stride = torch.tensor(stride if stage == "frame" else [1.0, 1.0])
        self.fit = detector.error_models.get(stage, ErrorModel())

    def forward(self, images: Tensor, *rough: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        output = self.network(images)
        if self.closeup:
            # The graph does not know which landmark a closeup shows, so it computes the correction for all three.
            one = closeup_peaks(output, self.config.size_px)
            three = Peaks(*(part.expand(-1, 3, *part.shape[2:]) for part in one))
            peaks = corrected(three, self.fit, self.config.size_px, np.arange(3))
        else:
            peaks = decode(output, self.config.stride, method=self.method)
        covariance, confidence = covariance_and_confidence(peaks, Rough.of(*rough) if rough else None, self.fit)
        if self.closeup:  # beyond the reach of a closeup nothing is found
            confidence = confidence * peaks.value
        stride = self.stride.to(peaks.u.dtype)
        return peaks.u * stride + (stride - 1) / 2, covariance * (stride[:, None] * stride), confidence


def export(detector: Detector, folder: str | Path, examples: np.ndarray | None = None) -> dict[str, tuple[Path, float]]:
    """Write every stage that agrees with torch as ``STAGE.onnx`` into `folder`.

    Returns for each stage the file and the largest difference from torch in px, over the landmarks that torch finds.

    The stages are compared on `examples`, frames (n, h, w, 3) uint8 with the tool in view; None = frames of the recording
    that ships.  The exported first stage takes frames of this size.  Raises ValueError if a stage differs by more than
    `LARGEST` (its file is then not written), if nothing is found in `examples`, or if a package is missing.
    """
    for package in ("onnx", "openvino"):  # onnx writes the files, openvino runs them for the comparison
        if not importlib.util.find_spec(package):
            raise ValueError(f"export: needs the package {package}, which is not installed here; `pip install {package}`.")
    if examples is None:
        frames = Recording.open(paths.SHIPPED_RECORDING).frames
        examples = np.stack([image for i in (0, len(frames) // 2) for image in (frames[i].left, frames[i].right)])
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    detector = replace(detector, engine="torch")
    rough, stride = detector(examples), detector.frame_stride(examples)
    result = {}
    for stage in detector.stages:
        (images, matrices, which), previous = detector.windows(examples, rough.u, stage), ()
        if stage not in ("frame", "tracking"):
            i = which[:, 0] if which.ndim == 2 else which
            parts = map_points(matrices[:, None], rough.u[i]), rough.confidence[i]
            previous = tuple(torch.from_numpy(part).float() for part in parts)
        if not len(images):
            raise ValueError("examples: no tool was found in them, so nothing can be compared; give other frames.")
        inputs = as_tensor(images).contiguous(), *previous
        module = StageWithDecoding(detector, stage, stride).eval()
        path = folder / f"{stage}.onnx"
        with files.whole(path) as partial:
            _write(module, inputs, partial)
            result[stage] = path, _difference(module, inputs, partial, stage)
    return result


def run_onnx(path: str | Path, *inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run an exported stage in float32 on images (n, 3, h, w) in [0, 1] and, if the stage takes them, on the rough landmarks
    and their confidence.  Returns u, covariance and confidence.
    """
    core = openvino().Core()
    found = core.compile_model(core.read_model(str(path)), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})(list(inputs))
    return found["u"], found["covariance"], found["confidence"]


def _write(module: nn.Module, example: tuple[Tensor, ...], path: Path) -> None:
    outputs, inputs = ["u", "covariance", "confidence"], ["images", "rough_u", "rough_confidence"][: len(example)]
    options = {"dynamo": False, "opset_version": 18, "dynamic_axes": {name: {0: "n"} for name in [*inputs, *outputs]}}
    with torch.no_grad(), warnings.catch_warnings(action="ignore"):  # they say that tracing fixes the sizes: this is intended
        torch.onnx.export(module, example, str(path), input_names=inputs, output_names=outputs, **options)


def _difference(module: nn.Module, inputs: tuple[Tensor, ...], path: Path, stage: str) -> float:
    """Returns the largest difference between ONNX and torch in px.  Raises ValueError if one exceeds `LARGEST`."""
    u, covariance, confidence = run_onnx(path, *(part.numpy() for part in inputs))
    with torch.inference_mode():
        u_torch, covariance_torch, confidence_torch = (part.numpy() for part in module(*inputs))
    if not (found := confidence_torch >= MISSING_BELOW).any():
        raise ValueError(f"examples: the stage {stage!r} finds nothing in them; give other frames.")
    variance = np.trace(covariance_torch, axis1=-2, axis2=-1)[..., None, None]
    differences = {
        "px": np.abs(u - u_torch)[found].max(),
        "of variance": (np.abs(covariance - covariance_torch) / variance)[found].max(),
        "of confidence": np.abs(confidence - confidence_torch).max(),
    }
    for unit, value in differences.items():
        if not value <= LARGEST[unit]:
            raise ValueError(f"{stage}: ONNX and torch differ by {value:.3g} {unit}, above {LARGEST[unit]}; not exported.")
    return float(differences["px"])
