"""The detector: images in, landmarks with covariance and confidence out.

Coarse to fine on the CPU: the whole frame at low resolution finds the tool, one upright window round the tool names its
landmarks, a small window at full resolution finds each, and a closeup measures it.  The first stage alone, at full
resolution, is the paper's detector.
Everything a detector needs lies in one safetensors file: weights, configuration, calibration and provenance.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as safetensors_bytes
from torch import Tensor

from lib import paths
from lib.geometry import image_from_cell
from lib.landmarks.engines import accelerated, default_engine
from lib.landmarks.heatmaps import Peaks, decode
from lib.landmarks.network import OffsetNetwork, StackedHourglass, config_of, network_of
from lib.landmarks.windows import (
    CLOSEUP_ZOOM,
    closeup_from_image,
    cut,
    direction_rad,
    expected_in_closeup,
    tool_centre,
    window_from_image,
)
from lib.parallel import single_threaded_torch

__all__ = ["Calibration", "Detector", "Landmarks", "as_tensor", "joined", "read_checkpoint", "write_checkpoint"]

FORMAT = "microstereo.detector"
#: Of the code between weights and landmarks (windows, decoding, what is missing): raised with every change of it that moves
#: landmarks, so that kept detections are made anew.
CODE_VERSION = 4
#: Landmarks below this confidence are missing: NaN.
MIN_CONFIDENCE = 0.05
#: Landmarks below this confidence are neither looked at closely nor followed from frame to frame.
MIN_TRACKED = 0.5
#: Stages that look at closeups: of what the windows found, and of what was found in the frame before.
CLOSE = ("closeup", "tracking")
#: A closeup is believed if it sees its landmark nearer than this to where that was thought to be, image pixels.
CLOSEUP_REACH_PX = 20.0


@dataclass(frozen=True)
class Landmarks:
    """Detections of n images; the order is base, tip_1, tip_2.

    Attributes
    ----------
    u:
        (n, 3, 2) px, NaN where missing.
    covariance:
        (n, 3, 2, 2) px^2, NaN where missing.
    confidence:
        (n, 3), the probability that the landmark is in view and `u` lies within 5 % of the tool's length of it;
        0 where missing.
    """

    u: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, index: slice | np.ndarray) -> Landmarks:
        return Landmarks(self.u[index], self.covariance[index], self.confidence[index])


@dataclass(frozen=True)
class Calibration:
    """What makes covariance and confidence true, fitted on validation images (`lib.training.evaluation.calibrate`).

    The covariance of a peak is diagonal in the axes of its stage's input: in the upright windows along the tool and across
    it, where errors are as different as the image is sharp.  log of the variance in px^2 = coefficients . features,
    logit of the confidence = `logit` . features; the features are in `peak_features`.

    There is a row for each landmark; `calibrate` gives the tips, each other's mirror images, equal ones.

    Attributes
    ----------
    log_variance:
        (2, 6): for x and y the constants of base, tip_1 and tip_2, and the slopes of the other three features.
    logit:
        (4,).
    gain, bias:
        (3, 2): of base, tip_1 and tip_2 along x and y, how much of the way from where a closeup expects its landmark to
        where it sees it is believed (the window that said where to look knows something too), and how far beyond its
        landmark that still is, in the closeup's pixels.
    """

    log_variance: tuple[tuple[float, ...], ...] = ((0.0, 0.0, 0.0, 1.0, 0.0, 0.0),) * 2
    logit: tuple[float, ...] = (-4.0, 0.0, 8.0, 0.0)
    gain: tuple[tuple[float, ...], ...] = ((1.0, 1.0),) * 3
    bias: tuple[tuple[float, ...], ...] = ((0.0, 0.0),) * 3

    @classmethod
    def of(
        cls,
        log_variance: Sequence[Sequence[float]],
        logit: Sequence[float],
        gain: Sequence[Sequence[float]] = ((1.0, 1.0),) * 3,
        bias: Sequence[Sequence[float]] = ((0.0, 0.0),) * 3,
    ) -> Calibration:
        """From the lists that JSON keeps.

        Raises
        ------
        ValueError
            For lists of other lengths.
        """
        if [np.shape(part) for part in (log_variance, logit, gain, bias)] != [(2, 6), (4,), (3, 2), (3, 2)]:
            raise ValueError("calibration: is of another version; make it anew (`train assemble`, or the study).")
        return cls(tuple(map(tuple, log_variance)), tuple(logit), tuple(map(tuple, gain)), tuple(map(tuple, bias)))

    @property
    def coefficients(self) -> np.ndarray:
        """(3, 2, 4): of the features in each landmark's log variance along x and y."""
        rows = np.array(self.log_variance)
        return np.stack([np.column_stack([rows[:, k], rows[:, 3:]]) for k in range(3)])


def peak_features(variance_px2: Tensor, value: Tensor, width: Tensor) -> Tensor:
    """(..., 4): 1, log of a variance in px^2, height of the peak, |log of its relative width|."""
    variance = variance_px2.clamp(1e-4, 1e4).log()
    return torch.stack([torch.ones_like(value), variance, value.clamp(-0.5, 1.5), width.log().abs()], dim=-1)


def features_of(peaks: Peaks, scale: float) -> Tensor:
    """`peak_features` (..., 3, 4) of peaks whose pixels are `scale` image pixels: of the variances along x, y, and both."""
    covariance = peaks.covariance * scale**2
    covariance = torch.where(torch.isfinite(covariance), covariance, torch.eye(2, dtype=covariance.dtype))
    (xx, xy), (yx, yy) = (row.unbind(-1) for row in covariance.unbind(-2))
    both = (xx * yy - xy * yx).clamp_min(1e-12).sqrt()
    return torch.stack([peak_features(v, peaks.value, peaks.width) for v in (xx, yy, both)], -2)


def calibrated(peaks: Peaks, scale: float, log_variance: Tensor, logit: Tensor) -> tuple[Tensor, Tensor]:
    """Covariance (..., 2, 2) px^2 and confidence (...) of peaks; torch can trace it.

    `log_variance` (..., 2, 4) are the `Calibration.coefficients` of each peak's landmark, `logit` is (4,).
    """
    features = features_of(peaks, scale)
    variance = (features[..., :2, :] * log_variance).sum(-1).clamp(-12, 12).exp()
    confidence = torch.sigmoid((features[..., 2, :] * logit).sum(-1))
    return variance[..., None] * torch.eye(2, dtype=variance.dtype), confidence


def closeup_peaks(found: Tensor, size_px: int) -> Peaks:
    """What an `OffsetNetwork` says of closeups, (n, 4), as peaks (n, 1): of height and width 1, and of its variances.

    A Laplace distribution of scale b has the variance 2 b^2.
    """
    u = (size_px - 1) / 2 + found[:, None, :2]
    one = torch.ones_like(u[..., 0])
    variance = 2 * (2 * found[:, None, 2:]).exp()
    return Peaks(u, one, one, variance[..., None] * torch.eye(2, dtype=variance.dtype))


def believed(peaks: Peaks, expected: Tensor, gain: Tensor, bias: Tensor, reach: Tensor) -> Peaks:
    """Closeups' peaks, `Calibration.gain` of the way from where their landmark was `expected`, less the bias.

    All three (n, k, 2) or one for all.  Beyond `reach` (n, k) closeup pixels, further than it was trained for, the network
    sees another thing: such peaks have the value 0.  Torch can trace it.
    """
    move = peaks.u - expected
    near = (move.square().sum(-1) < reach.square()).to(move.dtype)
    return replace(peaks, u=expected + gain * move - bias, value=peaks.value * near)


def as_tensor(images: ArrayLike | Tensor) -> Tensor:
    """Images (n, h, w, 3), uint8 or float in [0, 1], as the networks take them: (n, 3, h, w) float, channels last.

    Raises
    ------
    ValueError
        For another shape, type or range.
    """
    array = np.asarray(images)
    if array.ndim != 4 or array.shape[-1] != 3:
        raise ValueError(
            f"images: expected (n, h, w, 3) RGB, got {array.shape}. "
            "Add a first axis for one image; repeat a grey channel three times; drop an alpha channel."
        )
    if not array.size:
        raise ValueError(f"images: empty, {array.shape}.")
    tensor = torch.from_numpy(np.ascontiguousarray(array)).permute(0, 3, 1, 2)
    if array.dtype == np.uint8:
        return tensor.float().div_(255.0)
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"images: expected uint8 or float, got {array.dtype}; convert with astype(np.uint8).")
    low, high = float(array.min()), float(array.max())
    if not (low >= 0.0 and high <= 1.0):
        raise ValueError(f"images: float images must lie in [0, 1], got {low:g} to {high:g}; divide by 255?")
    return tensor.float()


def write_checkpoint(path: str | Path, tensors: dict[str, Tensor], metadata: dict[str, object]) -> None:
    """Write a safetensors file with JSON metadata, whole or not at all: a full disk leaves the old file as it was."""
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    data = safetensors_bytes(
        {name: tensor.detach().contiguous() for name, tensor in tensors.items()},
        metadata={name: json.dumps(value) for name, value in metadata.items()},
    )
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OSError(
            error.errno, f"{path}: not saved ({error.strerror}); an earlier file there is unharmed"
        ) from error


def read_checkpoint(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Tensors and metadata of a file that `write_checkpoint` wrote with ``metadata["format"] == kind``.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is none, or it is corrupt or something else.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file; train one with `python3 -m lib train`.")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = {name: json.loads(value) for name, value in (file.metadata() or {}).items()}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, json.JSONDecodeError, OSError) as error:
        raise ValueError(f"{path}: corrupt or no safetensors file of this program ({error}).") from error
    if metadata.get("format") != kind:
        raise ValueError(f"{path}: holds {metadata.get('format', 'foreign weights')!r}, expected {kind!r}.")
    return tensors, metadata


def load_network(path: str | Path, config: dict, tensors: dict[str, Tensor]) -> StackedHourglass | OffsetNetwork:
    """A network from its configuration and weights; errors name the file."""
    try:
        network = network_of(config_of(config))
        network.load_state_dict(tensors)
    except (TypeError, RuntimeError, ValueError) as error:
        raise ValueError(f"{path}: its weights do not fit its configuration ({str(error).splitlines()[0]}).") from error
    return network


@dataclass(frozen=True, eq=False)
class Detector:
    """Landmarks of whole frames, any size, any number; the same object for the left and the right camera.

    Attributes
    ----------
    frame_network:
        Sees the frame reduced by `reduction`.
    reduction:
        Image pixels per pixel of the frame network's input, an integer; 1 is the paper's whole-frame detector.
    window_network:
        Sees upright full-resolution windows of `window_px` around each landmark; None = there is no such stage.
    tool_network, tool_reduction:
        Sees one upright window of `window_px` round the tool, that much reduced, between the two; None = no such stage.
    closeup_network:
        Sees a closeup of each landmark that the windows found, and says where in it the landmark lies; None = no such stage.
    calibration:
        One per stage: ``"frame"``, ``"tool"``, ``"window"`` and ``"closeup"``; and ``"tracking"`` of the closeups that follow
        a landmark from frame to frame.
    mirror:
        The windows' network looks at every window and its mirror image, and takes the mean: twice the work.
    engine:
        What runs the networks, one of `lib.landmarks.engines.ENGINES`; the weights are the same.
    """

    frame_network: StackedHourglass
    reduction: int = 1
    window_network: StackedHourglass | None = None
    tool_network: StackedHourglass | None = None
    tool_reduction: int = 5
    window_px: int = 128
    method: str = "gauss_newton"
    calibration: dict[str, Calibration] = field(default_factory=dict)
    metadata: dict[str, object] = field(default_factory=dict)
    closeup_network: OffsetNetwork | None = None
    mirror: bool = False
    engine: str = "torch"

    def __post_init__(self) -> None:
        if self.reduction < 1 or self.reduction != int(self.reduction):
            raise ValueError(f"reduction: must be a positive integer, got {self.reduction}.")
        if self.closeup_network and not self.window_network:
            raise ValueError("closeup_network: looks at what a window_network has found; give one.")
        if self.mirror and self.window_network and self.window_px % self.window_network.stride:
            raise ValueError(f"mirror: needs window_px to be a multiple of the stride, got {self.window_px}.")
        fast = {
            name: accelerated(network, self.engine, mirror=self.mirror and name == "window")
            for name, network in self.networks.items()
        }
        object.__setattr__(self, "_fused", fast)

    @property
    def networks(self) -> dict[str, StackedHourglass | OffsetNetwork]:
        """The stages there are, in the order of their use."""
        stages = {
            "frame": self.frame_network,
            "tool": self.tool_network,
            "window": self.window_network,
            "closeup": self.closeup_network,
        }
        return {name: network for name, network in stages.items() if network is not None}

    @property
    def stages(self) -> list[str]:
        """What has a calibration: the networks, and tracking, which looks through that of the closeups."""
        return [*self.networks, *(["tracking"] if self.closeup_network else [])]

    # Files

    @classmethod
    def load(cls, path_or_name: str | Path | None = None, *, engine: str | None = None) -> Detector:
        """A detector from a weights file, or from a name in ``data/models``; None is the shipped default.

        `engine` runs its networks; None is the fastest that is installed (`lib.landmarks.engines`).

        Raises
        ------
        FileNotFoundError, ValueError
            Naming the file: missing, corrupt, or not a detector.
        """
        path = Path(path_or_name or "default")
        if not path.suffix and not path.is_file():
            path = paths.MODELS / f"{path.name}.safetensors"
        tensors, metadata = read_checkpoint(path, FORMAT)
        parts: dict[str, StackedHourglass | OffsetNetwork] = {}
        for name, config in metadata["networks"].items():
            own = {key.removeprefix(name + "."): value for key, value in tensors.items() if key.startswith(name + ".")}
            parts[name] = load_network(path, config, own)
        return cls(
            parts["frame"],
            reduction=metadata["reduction"],
            window_network=parts.get("window"),
            tool_network=parts.get("tool"),
            tool_reduction=metadata["tool_reduction"],
            window_px=metadata["window_px"],
            method=metadata["method"],
            calibration={name: Calibration.of(*fit) for name, fit in metadata["calibration"].items()},
            metadata=metadata["provenance"],
            closeup_network=parts.get("closeup"),
            mirror=metadata.get("mirror", False),
            engine=engine or default_engine(),
        )

    def save(self, path: str | Path) -> None:
        """Write the detector as one safetensors file."""
        networks = self.networks
        tensors = {
            f"{name}.{key}": value for name, network in networks.items() for key, value in network.state_dict().items()
        }
        metadata = {
            "format": FORMAT,
            "networks": {name: asdict(network.config) for name, network in networks.items()},
            "reduction": self.reduction,
            "tool_reduction": self.tool_reduction,
            "window_px": self.window_px,
            "mirror": self.mirror,
            "method": self.method,
            "calibration": {
                name: [fit.log_variance, fit.logit, fit.gain, fit.bias] for name, fit in self.calibration.items()
            },
            "provenance": self.metadata,
        }
        write_checkpoint(path, tensors, metadata)

    # Detection

    def __call__(self, images: ArrayLike, *, batch: int = 4) -> Landmarks:
        """Landmarks of images (n, h, w, 3), uint8 RGB or float in [0, 1]; `batch` images at a time.

        Raises
        ------
        ValueError
            For images of another shape, type or range.
        """
        images = _images(images)
        found = []
        with self._threads():
            for start in range(0, len(images), batch):
                part = images[start : start + batch]
                peaks, _ = self.frame_peaks(part)
                result = _missing(self._calibrated(peaks, "frame", self.reduction))
                for stage in list(self.networks)[1:]:
                    result = self._refined(part, result, stage)
                found.append(result)
        return _missing(joined(found))

    def track(self, images: ArrayLike, previous: Landmarks, *, min_confidence: float = MIN_TRACKED) -> Landmarks:
        """Landmarks of the frames that follow `previous`: closeups (or windows) alone, the whole frame where they fail.

        Parameters
        ----------
        images:
            (n, h, w, 3), such as the left and the right image of one time.
        previous:
            Landmarks of the n images before.
        min_confidence:
            An image with a landmark below this is searched as a whole.
        """
        images = _images(images)
        if len(previous) != len(images):
            raise ValueError(f"previous: holds {len(previous)} images, but images {len(images)}.")
        if self.window_network is None:
            return self(images)
        usable = np.flatnonzero((previous.confidence >= min_confidence).all(1) & np.isfinite(previous.u).all((1, 2)))
        result = Landmarks(
            np.full((len(images), 3, 2), np.nan), np.full((len(images), 3, 2, 2), np.nan), np.zeros((len(images), 3))
        )
        if usable.size:
            with self._threads():
                part = images if usable.size == len(images) else images[usable]  # a pair of frames takes 12 MB
                near, stage = previous[usable], "window" if self.closeup_network is None else "tracking"
                # The first closeup says where to look closely.
                for _ in range(1 if stage == "window" else 2):
                    near = self._refined(part, near, stage)
                _put(result, usable, near)
        lost = np.flatnonzero((result.confidence < min_confidence).any(1))
        if lost.size:
            _put(result, lost, self(images[lost]))
        return _missing(result)

    def _threads(self) -> AbstractContextManager[None]:
        """One thread for small windows, torch's own for whole frames."""
        return nullcontext() if self.window_network is None else single_threaded_torch()

    def frame_heatmaps(self, images: ArrayLike) -> Tensor:
        """Heatmaps (n, 3, h, w) of the first stage."""
        reduced = self.reduced(_images(images))
        with torch.inference_mode():
            return self._fused["frame"](as_tensor(reduced))[-1]

    def frame_peaks(self, images: ArrayLike, method: str | None = None) -> tuple[Peaks, Tensor]:
        """What the first stage decodes, in pixels of its reduced input, and its heatmaps."""
        heatmaps = self.frame_heatmaps(images)
        return decode(heatmaps, self.frame_network.stride, method=method or self.method), heatmaps

    def windows(self, images: np.ndarray, u: ArrayLike, stage: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a stage after the first looks at, given the rough landmarks u (n, 3, 2); ``"tracking"`` at closeups too.

        Returns
        -------
        Windows (m, s, s, 3) uint8; window_from_image (m, 2, 3); the image (m,) of each window (``"tool"``), or image
        and landmark (m, 2) (the others).  A tool without base or tips, a missing landmark have none.
        """
        u = np.asarray(u, dtype=np.float64)
        angle = direction_rad(u)
        size = self.window_px if stage in ("tool", "window") else self.closeup_network.config.size_px
        if stage == "tool":
            image = which = np.flatnonzero(np.isfinite(angle))
            matrices = window_from_image(tool_centre(u[which]), angle[which], size, 1 / self.tool_reduction)
        else:
            which = np.argwhere(np.isfinite(u).all(2) & np.isfinite(angle)[:, None])
            image, landmark = which.T
            place = u[image, landmark], angle[image], size
            matrices = window_from_image(*place) if stage == "window" else closeup_from_image(*place, landmark)
        windows = [cut(images[i], matrix, size) for i, matrix in zip(image, matrices, strict=True)]
        return np.stack(windows) if windows else np.zeros((0, size, size, 3), np.uint8), matrices, which

    def explained(self, image: np.ndarray) -> tuple[Landmarks, np.ndarray, np.ndarray, np.ndarray]:
        """What the windows saw in one image (h, w, 3): landmarks, windows (m, s, s, 3), window_from_image (m, 2, 3), and
        each window's heatmap (m, c, c) of its own landmark."""
        found = self(image[None])
        windows, matrices, which = self.windows(image[None], found.u, "window")
        if not len(which):
            return found, windows, matrices, windows[..., 0]
        heat = self.outputs(windows, "window").numpy()[np.arange(len(which)), which[:, 1]]
        return found, windows, matrices, heat

    def outputs(self, windows: np.ndarray, stage: str) -> Tensor:
        """Heatmaps (m, 3, h, w) of windows (m, s, s, 3); of closeups what the `OffsetNetwork` says, (m, 4)."""
        with torch.inference_mode():
            return self._fused["closeup" if stage in CLOSE else stage](as_tensor(windows))[-1]

    def stage_peaks(self, images: np.ndarray, u: ArrayLike, stage: str) -> tuple[Peaks, np.ndarray, np.ndarray]:
        """What a window stage decodes: peaks (m, 1) in pixels of the windows, window_from_image (m, 2, 3), (m, 2) which.

        Each row of the last is image and landmark.
        """
        windows, matrices, which = self.windows(images, u, stage)
        if not len(which):
            empty = torch.zeros((0, 1))
            return (
                Peaks(torch.zeros((0, 1, 2)), empty, empty, torch.zeros((0, 1, 2, 2))),
                matrices,
                np.zeros((0, 2), int),
            )
        outputs = self.outputs(windows, stage)
        if stage in CLOSE:
            size, k = windows.shape[1], which[:, 1]
            fit, reach = self.calibration.get(stage, Calibration()), CLOSEUP_REACH_PX * np.array(CLOSEUP_ZOOM)
            parts = (expected_in_closeup(size, k), np.array(fit.gain)[k], np.array(fit.bias)[k], reach[k])
            belief = (torch.from_numpy(part)[:, None].float() for part in parts)
            return believed(closeup_peaks(outputs, size), *belief), matrices, which
        if stage == "tool":  # one window holds all three landmarks
            which = np.stack([np.repeat(which, 3), np.tile(np.arange(3), len(which))], axis=1)
            matrices, heatmaps = np.repeat(matrices, 3, axis=0), outputs.flatten(0, 1)[:, None]
        else:
            heatmaps = outputs[torch.arange(len(which)), torch.from_numpy(which[:, 1])][:, None]
        return decode(heatmaps, self.networks[stage].stride, method=self.method), matrices, which

    def _refined(self, images: np.ndarray, rough: Landmarks, stage: str) -> Landmarks:
        peaks, matrices, which = self.stage_peaks(images, rough.u, stage)
        result = Landmarks(rough.u.copy(), rough.covariance.copy(), rough.confidence.copy())
        if not len(which):
            return result
        fine = self._calibrated(peaks, stage, 1, which[:, 1:])
        back = np.linalg.inv(matrices[:, :, :2])
        u = (back @ (fine.u[:, 0] - matrices[:, :, 2])[..., None])[..., 0]
        covariance = back @ fine.covariance[:, 0] @ back.mT
        confidence = fine.confidence[:, 0]
        if stage in CLOSE:
            seen = peaks.value[:, 0].numpy() > 0
            confidence = np.where(seen, confidence, 0.0)
        if stage == "closeup":  # that the landmark is there the windows know; an unsure one is left where they saw it
            seen &= rough.confidence[which[:, 0], which[:, 1]] >= MIN_TRACKED
            u, covariance, which = u[seen], covariance[seen], which[seen]
        else:
            result.confidence[which[:, 0], which[:, 1]] = confidence
        i, k = which.T
        result.u[i, k], result.covariance[i, k] = u, covariance
        return _missing(result)

    def reduced(self, images: np.ndarray) -> np.ndarray:
        """Images averaged over blocks of `reduction` pixels, black beyond the right and bottom border."""
        r = self.reduction
        if r == 1:
            return images
        n, h, w, _ = images.shape
        images = np.pad(images, ((0, 0), (0, -h % r), (0, -w % r), (0, 0))) if h % r or w % r else images
        size = (images.shape[2] // r, images.shape[1] // r)
        return np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]) if n else images

    def _calibrated(self, peaks: Peaks, source: str, scale: int, landmark: np.ndarray | slice = np.s_[:]) -> Landmarks:
        """Peaks in pixels of a network's input to landmarks in image pixels; `landmark` says which each peak is."""
        u = image_from_cell(peaks.u.numpy(), scale)
        fit = self.calibration.get(source, Calibration())
        rows = (torch.as_tensor(row, dtype=torch.float64) for row in (fit.coefficients[landmark], fit.logit))
        covariance, confidence = calibrated(peaks.double(), scale, *rows)
        return Landmarks(u, covariance.numpy(), confidence.numpy())

    def with_calibration(self, **fits: Calibration) -> Detector:
        """A copy with the calibration of some stages (``frame=``, ``window=``, ...) replaced."""
        return replace(self, calibration={**self.calibration, **fits})


def _images(images: ArrayLike) -> np.ndarray:
    array = np.asarray(images)
    if array.dtype != np.uint8:
        as_tensor(array)  # raises what is wrong
        array = np.round(array * 255).astype(np.uint8)
    elif array.ndim != 4 or array.shape[-1] != 3 or not array.size:
        as_tensor(array)
    return array


def joined(parts: list[Landmarks]) -> Landmarks:
    """Landmarks of several sets of images, one after the other."""
    return Landmarks(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("u", "covariance", "confidence")))


def _put(into: Landmarks, rows: np.ndarray, values: Landmarks) -> None:
    into.u[rows], into.covariance[rows], into.confidence[rows] = values.u, values.covariance, values.confidence


def _missing(found: Landmarks) -> Landmarks:
    """NaN and confidence 0 for what is below `MIN_CONFIDENCE`."""
    missing = ~(found.confidence >= MIN_CONFIDENCE)
    return Landmarks(
        np.where(missing[..., None], np.nan, found.u),
        np.where(missing[..., None, None], np.nan, found.covariance),
        np.where(missing, 0.0, found.confidence),
    )
