"""The detector: images in, landmarks with covariance and confidence out.

It works from coarse to fine.  The first stage finds the tool in the whole frame, shrunk to a fixed size.  The second stage
locates the landmarks in one upright window, scaled so that every tool has the same length in it.  It looks twice, since the
first look corrects the window's direction and scale.  If the window does not show the tool well, this stage chooses between
several candidates.  The last stage measures each landmark in a closeup.  If the result is unsure, the detector looks again
with more contrast, then sweeps the image.  The paper's detector (Sec. III) is the first stage alone, at full resolution.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Self

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lib import paths
from lib.geometry import check, image_from_cell
from lib.landmarks import windows as view
from lib.landmarks.checkpoints import checksum, load_network, read_checkpoint, write_checkpoint
from lib.landmarks.contrast import equalised, levelled, stretched
from lib.landmarks.engines import accelerated, default_engine
from lib.landmarks.error_model import ErrorModel, Rough, closeup_peaks, corrected, covariance_and_confidence
from lib.landmarks.heatmaps import Peaks, decode
from lib.landmarks.metrics import tool_length_px
from lib.landmarks.network import Network, OffsetNetwork, StackedHourglass, as_tensor, as_uint8, images_for
from lib.landmarks.search import PEAKS, best_tools, likelihood, near_only, several_peaks
from lib.parallel import single_threaded_torch

FORMAT = "microstereo.detector"
#: The stages that use closeups: the first closeup, a second one if the first moved the landmark far, and tracking.
CLOSE = ("closeup", "closer", "tracking")
#: All stages in the order of their use, and the one whose network each uses.
_NETWORK_OF = {"frame": "frame", "tool": "tool", "again": "tool"} | dict.fromkeys(CLOSE, "closeup")
#: The fields that a weights file stores as plain values.
_SETTINGS = ("frame_px", "method")
#: A landmark with a lower confidence counts as missing: NaN, confidence 0.
MISSING_BELOW = 0.05
#: A landmark with a lower confidence is not followed from frame to frame.
TRACKED_FROM = 0.5
#: If the mean confidence of its landmarks is lower, the detector looks at an image again; chosen on validation images.
_UNSURE = 0.5
#: If the mean height of a window's peaks is lower than this, the first stage's peaks at these scales give candidates.
_GOOD_HEIGHT, _SCALES = 0.75, (0.75, 1.0, 1.5, 2.2)
_SURE = 0.5  # after a search, or if a confidence of the first stage is lower, confidences become this times the peaks' height
#: Number of candidates for a first look, number of those for a second, and the peak height below which there is no candidate.
_CANDIDATES, _SECOND_LOOKS, _NO_PEAK = 24, 6, 0.01
#: A sweep looks for tools of these lengths (shares of the longer side) at this many angles; chosen on validation images.
_SWEEP_LENGTHS, _SWEEP_ANGLES = (0.21, 0.1), 6
_SWEEP_FACTOR = 0.5  # on the confidence of a sweep's result, since the first stage did not confirm it
#: Share of the tool's length.  A detection farther than this from the expected position is taken for another object.
NEAR = 0.1
#: The second look at the tool averages the heatmaps of the window and of its mirror image: they are low if the two disagree.
MIRRORED = "again"
_Ground = Callable[[], np.ndarray] | None  # returns the images without the tool, as in `Detector.__call__`


@dataclass(frozen=True)
class Landmarks:
    """Detections in n images; the order is base, tip_1, tip_2.

    Attributes:
        u: (n, 3, 2) px, NaN where missing.
        covariance: (n, 3, 2, 2) px^2, NaN where missing.
        confidence: (n, 3), probability that the landmark is in view within 5 % of the tool's length of `u`; 0 where missing.

        >>> found = Landmarks.none(2)
        >>> len(found), len(found[:1]), found.u.shape
        (2, 1, (2, 3, 2))
    """

    u: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, index: slice | np.ndarray) -> Self:
        return Landmarks(self.u[index], self.covariance[index], self.confidence[index])

    @classmethod
    def none(cls, n: int) -> Self:
        """The result for n images in which nothing was found."""
        return cls(np.full((n, 3, 2), np.nan), np.full((n, 3, 2, 2), np.nan), np.zeros((n, 3)))

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Concatenate the landmarks of several sets of images."""
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("u", "covariance", "confidence")))

    def without_unsure(self) -> Self:
        """A copy in which every landmark below `MISSING_BELOW` is NaN with confidence 0."""
        missing, result = ~(self.confidence >= MISSING_BELOW), Landmarks.join([self])  # a copy
        result.u[missing], result.covariance[missing], result.confidence[missing] = np.nan, np.nan, 0.0
        return result

    @property
    def doubtful(self) -> np.ndarray:
        """(n,) bool: images whose landmarks have a low mean confidence."""
        return self.confidence.mean(1) < _UNSURE

    def away(self, u: np.ndarray) -> np.ndarray:
        """(n, 3) bool: landmarks farther than `NEAR` from the expected positions u (n, 3, 2) px."""
        return np.linalg.norm(self.u - u, axis=2) > NEAR * tool_length_px(u)[:, None]

    def put(self, rows: np.ndarray, values: Self) -> None:
        """Replace the landmarks of the images `rows`, in place."""
        self.u[rows], self.covariance[rows], self.confidence[rows] = values.u, values.covariance, values.confidence


@dataclass(frozen=True, eq=False)
class Detector:
    """Finds the landmarks in any number of frames of any size; one detector serves both cameras.

    Attributes:
        frame_network, frame_px: The first stage, and the longer side to which it shrinks the frame; None = full resolution.
        tool_network: The second stage, which looks at one window around the tool; None = no such stage.
        closeup_network: The last stage, which predicts the landmark's position in a closeup; None = no such stage.
        error_models: One for each stage: ``"frame"``, ``"tool"`` and ``"again"`` for the two looks at the tool, ``"closeup"``
            and ``"closer"`` for two closeups, the second if the first moved the landmark far, and ``"tracking"`` for the
            closeups that follow a landmark from frame to frame.
        engine: Runs the networks; one of `lib.landmarks.engines.ENGINES`.  The weights do not depend on it.

        >>> found = Detector.load(engine="torch")(np.zeros((1, 270, 480, 3), np.uint8))
        >>> found.u.shape, bool((found.confidence < 0.5).all())
        ((1, 3, 2), True)
    """

    frame_network: StackedHourglass
    frame_px: int | None = None
    tool_network: StackedHourglass | None = None
    method: str = "gauss_newton"
    error_models: dict[str, ErrorModel] = field(default_factory=dict)
    metadata: dict[str, object] = field(default_factory=dict)
    closeup_network: OffsetNetwork | None = None
    engine: str = "torch"
    _run: dict[str, Callable[[Tensor], list[Tensor]]] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        check(self, "frame_px", lambda v: v is None or v >= 16, "must be at least 16 px")
        if self.closeup_network and not self.tool_network:
            raise ValueError("closeup_network: needs the landmarks of a tool_network; give one.")
        run = cache(accelerated)  # stages may share a network
        for stage in self.stages:
            self._run[stage] = run(self.network_of(stage), self.engine, mirror=stage == MIRRORED)

    def network_of(self, stage: str) -> Network:
        """The network of a stage, which several stages may share."""
        return self.networks[_NETWORK_OF[stage]]

    @property
    def networks(self) -> dict[str, Network]:
        """The networks by stage, in the order of their use."""
        owners = dict.fromkeys(_NETWORK_OF.values())
        return {stage: network for stage in owners if (network := getattr(self, f"{stage}_network")) is not None}

    @property
    def stages(self) -> list[str]:
        """The stages in the order of their use, each with an error model; the last one, if any, is tracking."""
        return [stage for stage, owner in _NETWORK_OF.items() if owner in self.networks]

    @classmethod
    def load(cls, path_or_name: str | Path | None = None, *, engine: str | None = None) -> Self:
        """Load a detector from a weights file, or by its name in ``data/models``; None = the one that ships.

        `engine` runs its networks; None = the fastest one here (`lib.landmarks.engines.default_engine`).
        Raises FileNotFoundError or ValueError if the file is missing, damaged, incomplete, or not a detector.
        """
        path = Path(path_or_name or "default")
        named = paths.MODELS / f"{path}.safetensors"
        path = named if path.name == str(path) and named.is_file() and not path.is_file() else path
        tensors, metadata = read_checkpoint(path, FORMAT)
        if text := ", ".join(sorted({"networks", "calibration", "provenance", *_SETTINGS} - metadata.keys())):
            raise ValueError(f"{path}: its metadata lack {text}; get the file again, or make it with Detector.save.")
        if other := metadata["networks"].keys() - set(_NETWORK_OF.values()):
            raise ValueError(f"{path}: it has networks of unknown stages ({', '.join(sorted(other))}); train it anew.")
        configs = metadata["networks"].items()
        networks = {f"{name}_network": load_network(path, config, tensors, f"{name}.") for name, config in configs}
        try:
            detector = cls(
                **networks, **{name: metadata[name] for name in _SETTINGS},
                error_models={name: ErrorModel(*fit) for name, fit in metadata["calibration"].items()},
                metadata=metadata["provenance"], engine=engine or default_engine(),
            )  # fmt: skip
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error
        detector._check_complete(path)
        return detector

    def save(self, path: str | Path) -> None:
        """Write the detector as one safetensors file.  Raises ValueError if a stage has no error model.

        Weights that half precision represents exactly (`Network.halved`) take half the space.
        """
        self._check_complete(path)
        tensors, metadata = self._content()
        half = {name: value.half() for name, value in tensors.items() if value.is_floating_point()}
        exact = {name: value for name, value in half.items() if torch.equal(value.float(), tensors[name])}
        write_checkpoint(path, tensors | exact, metadata)

    @property
    def digest(self) -> str:
        """SHA-256 of everything that determines the results: weights, settings, error models and engine."""
        tensors, metadata = self._content()
        return checksum(tensors, metadata | {"engine": self.engine})

    def _content(self) -> tuple[dict[str, Tensor], dict[str, object]]:
        """Tensors and metadata for the detector's file."""
        states = {stage: network.state_dict() for stage, network in self.networks.items()}
        tensors = {f"{stage}.{key}": value for stage, state in states.items() for key, value in state.items()}
        return tensors, {name: getattr(self, name) for name in _SETTINGS} | {
            "format": FORMAT,
            "networks": {stage: asdict(network.config) for stage, network in self.networks.items()},
            "calibration": {stage: list(asdict(fit).values()) for stage, fit in self.error_models.items()},
            "provenance": self.metadata,
        }

    def _check_complete(self, path: str | Path) -> None:
        if lacking := [stage for stage in self.stages if stage not in self.error_models]:
            what = f"no error model for {', '.join(lacking)}, so covariance and confidence would mean nothing"
            cure = "fit them with `lib.training.error_models.fit_error_models` or `python3 -m lib train assemble`"
            raise ValueError(f"{path}: {what}; {cure}.")

    def __call__(self, images: ArrayLike, *, batch: int = 4, ground: _Ground = None) -> Landmarks:
        """Detect the landmarks in images (n, h, w, 3), uint8 RGB or float in [0, 1], `batch` images at a time.

        If the result is unsure, the detector looks again with more contrast, then sweeps the image, which takes many times
        as long.  `ground` returns the images (n, h, w, 3) uint8 without the tool, as `Recording.ground` does; an unsure
        detector then first looks at the difference from them.  Raises ValueError for another shape, type or range.
        """
        images = as_uint8(images)
        if batch < 1 or batch % 1:
            raise ValueError(f"batch: expected a number of images, 1 or more, got {batch}.")
        with self._threads():
            parts = (slice(start, start + batch) for start in range(0, len(images), batch))
            return Landmarks.join([self._seen(images[p], ground and (lambda p=p: ground()[p])) for p in parts])

    def _seen(self, images: np.ndarray, ground: _Ground) -> Landmarks:
        """Detect in a few images.  If unsure, look again with more contrast, then sweep; the surest result counts."""
        result = self._once(images)
        looks = [lambda i: equalised(images[i]), lambda i: stretched(images[i]), lambda i: images[i]]
        if ground is not None:
            looks.insert(0, lambda i: levelled(images[i], ground()[i]))
        for k, look in enumerate(looks if self.tool_network else (), 1):
            if len(unsure := np.flatnonzero(result.doubtful)):
                other = self._once(np.stack([look(i) for i in unsure]), sweep=k == len(looks))
                other = other if k < len(looks) else replace(other, confidence=_SWEEP_FACTOR * other.confidence)
                surer = other.confidence.mean(1) > result.confidence[unsure].mean(1)
                result.put(unsure[surer], other[surer])
        return result

    def _once(self, images: np.ndarray, sweep: bool = False) -> Landmarks:
        """Detect in a few images as given, by all stages but tracking; `sweep` as in `searched`."""
        rough = self.coarse(images)
        known = self.stage_peaks(images, rough.u, "tool") if self.tool_network else None
        result = self.searched(images, rough, known, sweep=sweep)
        same = np.array_equal(result.u, rough.u, equal_nan=True)
        before = rough
        for stage in [stage for stage in self.stages[1:] if stage != "tracking"]:
            far = view.moved_far(before.u, result.u) if stage == "closer" else None
            before = result
            result = self.refine(images, result, stage, known if same and stage == "tool" else None, only=far)
        return result

    def track(
        self, images: ArrayLike, previous: Landmarks, *, min_confidence: float = TRACKED_FROM, ground: _Ground = None
    ) -> Landmarks:
        """Follow the landmarks `previous` into the images (n, h, w, 3), such as the next left and right image.

        Only closeups are used.  An image with a landmark below `min_confidence` is searched as in a call, with `ground`.
        """
        images = images_for(previous, "previous", images)
        if self.closeup_network is None:
            return self(images, ground=ground)
        usable = np.flatnonzero((previous.confidence >= min_confidence).all(1) & np.isfinite(previous.u).all((1, 2)))
        result = Landmarks.none(len(images))
        if usable.size:
            with self._threads():
                part, near = images if usable.size == len(images) else images[usable], previous[usable]  # a pair takes 12 MB
                found = self.refine(part, near, "tracking")
                result.put(usable, self.refine(part, found, "tracking", only=view.moved_far(near.u, found.u)))
        if len(lost := np.flatnonzero((result.confidence < min_confidence).any(1))):
            result.put(lost, self(images[lost], ground=ground and (lambda: ground()[lost])))
        return result.without_unsure()

    def near(self, images: np.ndarray, u: np.ndarray, *, ground: _Ground = None, reach: float | None = None) -> Landmarks:
        """Detect by the later stages alone, in images (n, h, w, 3) at expected positions u (n, 3, 2) px; NaN = unknown.

        Detections farther away than `NEAR` are missing.  With `reach`, a share of the tool's length, only peaks within it
        count.  With `ground`, as in a call, each landmark is that of the image or of the levelled image, the surer.
        """
        images, known = images_for(u, "u", images), np.isfinite(u).all(axis=2)
        known &= known[:, :1] & known[:, 1:].any(axis=1, keepdims=True)  # no window without base and tip
        u = np.where(known[..., None], u, np.nan)
        found = Landmarks(u, np.tile(np.eye(2), (len(u), 3, 1, 1)), known.astype(float))
        # A window shows the whole tool.  With closeups alone, their constant error would add up if the caller repeats this.
        for stage in [stage for stage in self.stages if stage in ("again", "closeup", "closer")]:
            found = self.refine(images, found, stage, reach=reach)
        found.confidence[found.away(u)] = 0.0
        if ground is not None:
            other = self.near(np.stack([levelled(*one) for one in zip(images, ground(), strict=True)]), u, reach=reach)
            found.put(surer := np.nonzero(other.confidence > found.confidence), other[surer])
        return found.without_unsure()

    def _threads(self) -> AbstractContextManager[None]:
        """Use one thread for small windows, and torch's own number for whole frames."""
        return single_threaded_torch() if len(self.networks) > 1 else nullcontext()

    def coarse(self, images: np.ndarray) -> Landmarks:
        """Detect by the first stage alone."""
        return self.refine(images, Landmarks.none(len(images)), "frame")

    def searched(self, images: np.ndarray, rough: Landmarks, seen: tuple | None = None, *, sweep: bool = False) -> Landmarks:
        """Choose where the later stages start: at `rough`, or, if its window does not show it well, at the best candidate.

        Candidates are `rough` and tools made of the highest peaks of the first stage at several scales.  The second stage
        looks at all of them once and at the likeliest ones again; the likeliest wins.  The second stage decides even if the
        first is sure, since it was trained on negatives.  `seen` is the result of `stage_peaks` for `rough`, if known.  With
        `sweep` the candidates are those of `swept`.
        """
        if self.tool_network is None:
            return rough
        result = Landmarks.join([rough])  # a copy
        height = self._shown(seen or self.stage_peaks(images, rough.u, "tool"), len(images))[1]
        searched = height < _GOOD_HEIGHT
        for i in np.flatnonzero(searched):
            tools, u, once = self.swept(images[i]) if sweep else self.proposed(images[i], rough.u[i : i + 1])
            best = np.argsort(-likelihood(u, once))[:_SECOND_LOOKS]
            u, twice = self._looked(images[i], u[best], "again")
            chosen = likelihood(u, twice).argmax()
            result.u[i], result.covariance[i] = tools[best[chosen]], np.nan
            height[i] = twice[chosen]
        unsure = searched | (rough.confidence < _SURE).any(1)
        return replace(result, confidence=np.where(unsure[:, None], _SURE * height[:, None], rough.confidence))

    def proposed(self, image: np.ndarray, *others: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Candidate tools u (m, 3, 2) px in an image (h, w, 3): `others`, and combinations of the first stage's peaks.

        Also returns what the second stage finds there: u (m, 3, 2) px and the mean height (m,) of the peaks.
        """
        u, height, one = [], [], image[None]
        for scale in _SCALES:
            at, value = several_peaks(self.outputs(self.reduced(one, scale), "frame"), PEAKS, self.frame_network.stride)
            u.append(image_from_cell(at, self.frame_stride(one, scale)))
            height.append(value)
        u, height = np.concatenate(u), np.concatenate(height)
        which = best_tools(u, height, _CANDIDATES) if height.max() > _NO_PEAK else np.zeros((0, 3), int)
        tools = np.concatenate([*others, u[which, np.arange(3)]])
        return tools, *self._looked(image, tools, "tool")

    def swept(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `proposed`, but by the second stage, which sees the whole image (h, w, 3) at several scales and angles."""
        tools, height, sides = [], [], np.array(image.shape[1::-1])
        for length, turn in product(_SWEEP_LENGTHS, (2 * np.pi * np.arange(_SWEEP_ANGLES) / _SWEEP_ANGLES).tolist()):
            zoom, (c, s) = view.tool_zoom(length * sides.max()), np.abs([np.cos(turn), np.sin(turn)])
            size = np.ceil(zoom * (np.array([[c, s], [s, c]]) @ sides)).astype(int)
            matrix = view.window_from_image((sides - 1) / 2, turn, size, zoom)
            heatmaps = self.outputs(view.cut(image, matrix, size)[None], "tool")
            u, value = several_peaks(heatmaps, PEAKS, self.tool_network.stride)
            at = best_tools(u, value, PEAKS), np.arange(3)
            tools.append(view.unmapped(matrix[None], u[at].reshape(-1, 2)).reshape(-1, 3, 2))
            height.append(np.clip(value[at], 0, 1).mean(axis=1))
        u = np.concatenate(tools)
        return u, u, np.concatenate(height)

    def _looked(self, image: np.ndarray, u: np.ndarray, stage: str) -> tuple[np.ndarray, np.ndarray]:
        """`_shown` for several candidate tools u (n, 3, 2) px in one image."""
        return self._shown(self.stage_peaks(np.broadcast_to(image, (len(u), *image.shape)), u, stage), len(u))

    @staticmethod
    def _shown(seen: tuple, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Convert the result of `stage_peaks` for n tools to landmarks (n, 3, 2) px and the peaks' mean height (n,)."""
        peaks, matrices, which = seen
        i, k = which.T
        found, height = np.full((n, 3, 2), np.nan), np.zeros((n, 3))
        found[i, k] = view.unmapped(matrices, peaks.u[:, 0].double().numpy())
        height[i, k] = peaks.value[:, 0].numpy()
        return found, np.clip(height, 0, 1).mean(1)

    def refine(
        self, images: np.ndarray, rough: Landmarks, stage: str, seen: tuple | None = None, *, only: np.ndarray | None = None,
        reach: float | None = None,
    ) -> Landmarks:  # fmt: skip
        """Refine the landmarks `rough` by a stage, or by ``"tracking"``; the first stage does not use them.

        `seen` is the result of `stage_peaks` for them, if known; `only` and `reach` are its arguments.
        """
        peaks, matrices, which = seen or self.stage_peaks(images, rough.u, stage, only, reach)
        result = Landmarks.join([rough])  # a copy
        # While tracking, the previous frame's result is no evidence.
        before = None if stage in ("frame", "tracking") else Rough.in_windows(rough.u, rough.confidence, matrices, which)
        fit = self.error_models.get(stage, ErrorModel())
        fine = covariance_and_confidence(peaks.double(), before, fit, which[:, 1:])  # in pixels of the stage's input
        own, confidence = (part[:, 0].numpy() for part in fine)
        u, back = view.unmapped(matrices, peaks.u[:, 0].numpy()), np.linalg.inv(matrices[:, :, :2])
        covariance = back @ own @ back.mT
        if stage in CLOSE:
            near = peaks.value[:, 0].numpy() > 0
            confidence = np.where(near, confidence, 0.0)
        if stage in ("closeup", "closer"):
            # The previous stage decides whether the landmark is there.  An unsure closeup does not move it.
            result.confidence[tuple(which[near & (confidence < MISSING_BELOW)].T)] = MISSING_BELOW
            near &= confidence >= MISSING_BELOW
            u, covariance, confidence, which = u[near], covariance[near], confidence[near], which[near]
        i, k = which.T
        result.u[i, k], result.covariance[i, k], result.confidence[i, k] = u, covariance, confidence
        return result if stage == "tool" else result.without_unsure()  # the second look may be surer

    def windows(
        self, images: np.ndarray, u: ArrayLike, stage: str, only: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cut a stage's inputs around rough landmarks u (n, 3, 2); closeups may be limited to `only` (n, 3) bool.

        Returns windows (m, h, w, 3) uint8; window_from_image (m, 2, 3); and the index (m, 2) of the image and landmark in
        each window, or of the image (m,) if a window shows the whole tool.  Missing landmarks, and tools without base or
        tips, have no window.  The first stage's windows are the whole images, whatever u is.
        """
        if stage == "frame":
            stride = self.frame_stride(images)
            matrix = np.column_stack([np.diag(1 / stride), (1 / stride - 1) / 2])
            return self.reduced(images), np.tile(matrix, (len(images), 1, 1)), np.arange(len(images))
        u = np.asarray(u, dtype=np.float64)
        (centre, angle), length = view.tool_pose(u), np.maximum(tool_length_px(u), 1.0)
        if stage in ("tool", "again"):
            size, image = view.TOOL_PX, np.flatnonzero(np.isfinite(angle))
            matrices = view.window_from_image(centre[image], angle[image], size, view.tool_zoom(length[image]))
            which = image
        else:
            size = self.closeup_network.config.size_px
            which = np.argwhere(np.isfinite(u).all(2) & np.isfinite(angle)[:, None] & (True if only is None else only))
            image, landmark = which.T
            matrices = view.closeup_from_image(u[image, landmark], angle[image], size, landmark, length[image])
        windows = [view.cut(images[i], matrix, size) for i, matrix in zip(image, matrices, strict=True)]
        return np.stack(windows) if windows else np.zeros((0, size, size, 3), np.uint8), matrices, which

    def outputs(self, images: np.ndarray, stage: str) -> Tensor:
        """Compute a stage's heatmaps (m, 3, h, w) of its inputs (m, s, s, 3), or an `OffsetNetwork`'s outputs (m, 4)."""
        with torch.inference_mode():
            return self._run[stage](as_tensor(images))[-1]

    def stage_peaks(
        self, images: np.ndarray, u: ArrayLike, stage: str, only: np.ndarray | None = None, reach: float | None = None
    ) -> tuple[Peaks, np.ndarray, np.ndarray]:
        """Peaks (m, 1) of a stage in its windows' pixels; window_from_image (m, 2, 3); image and landmark (m, 2).

        `only` (n, 3) bool limits closeups to some landmarks.  In a window, which shows all three landmarks, only peaks within
        `reach` of u count, a share of the tool's length; None = all.
        """
        windows, matrices, which = self.windows(images, u, stage, only)
        if not len(which):
            return Peaks(*(torch.zeros(0, 1, *s) for s in ((2,), (), (), (2, 2), ()))), matrices, np.zeros((0, 2), int)
        outputs = self.outputs(windows, stage)
        if stage in CLOSE:
            size, fit = windows.shape[1], self.error_models.get(stage, ErrorModel())
            return corrected(closeup_peaks(outputs, size), fit, size, which[:, 1:]), matrices, which
        stride = self.network_of(stage).stride
        if reach is not None:
            outputs = near_only(outputs, view.map_points(matrices[:, None], np.asarray(u)[which]), reach, stride)
        which = np.stack([np.repeat(which, 3), np.tile(np.arange(3), len(which))], axis=1)
        peaks = decode(outputs.flatten(0, 1)[:, None], stride, method=self.method)
        return peaks, np.repeat(matrices, 3, axis=0), which

    def frame_stride(self, images: np.ndarray, scale: float = 1.0) -> np.ndarray:
        """Image pixels per pixel of the first stage's input, along x and y; `scale` is a factor on the input's size."""
        size = np.array(images.shape[2:0:-1])
        return size / np.maximum(np.round(size * (scale * (self.frame_px or size.max()) / size.max())), 1)

    def reduced(self, images: np.ndarray, scale: float = 1.0) -> np.ndarray:
        """Resize images (n, h, w, 3) for the first stage: the longer side becomes `scale` times `frame_px`."""
        stride = self.frame_stride(images, scale)
        if (stride == 1).all():
            return images
        size = tuple(int(v) for v in np.round(images.shape[2:0:-1] / stride))
        method = cv2.INTER_AREA if stride.max() > 1 else cv2.INTER_LINEAR
        if stride.min() >= 4:  # halving first is faster in OpenCV
            half = tuple(side // 2 for side in images.shape[2:0:-1])
            images = [cv2.resize(image, half, interpolation=method) for image in images]
        return np.stack([cv2.resize(image, size, interpolation=method) for image in images])
