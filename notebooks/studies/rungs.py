"""The kinds of images (rungs) that judge a detector, increasingly unlike those of its training.

They are near, far and real frames, near frames with changes, and images without a tool.  Nothing may be chosen by them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from lib import paths
from lib.landmarks.metrics import nees, pck
from lib.recordings import Recording
from lib.simulator.families import FAR
from lib.simulator.population import sample
from lib.training.evaluation import Evaluation
from lib.training.samples import LabelledImage, labelled_images
from notebooks.studies.retinal import import_retinal_microsurgery

Change = Callable[[np.ndarray, np.random.Generator], tuple[np.ndarray, float]]


def _grey(image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    return np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2), 1.0


def _hue(image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    hsv[..., 0] = (hsv[..., 0].astype(int) + rng.integers(30, 150)) % 180
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), 1.0


def _resized(factor: float) -> Change:
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return lambda image, rng: (cv2.resize(image, None, fx=factor, fy=factor, interpolation=how), factor)


def _brightness(factor: float) -> Change:
    return lambda image, rng: (cv2.convertScaleAbs(image, alpha=factor), 1.0)


#: Changes of near frames: name -> function of an image that returns the changed image and its scale.
CHANGES: dict[str, Change] = {
    "grey": _grey,
    "red and blue swapped": lambda image, rng: (np.ascontiguousarray(image[..., ::-1]), 1.0),
    "hue turned": _hue,
    "half size": _resized(0.5),
    "double size": _resized(2.0),
    "half brightness": _brightness(0.5),
    "double brightness": _brightness(2.0),
    "blurred by 16 px": lambda image, rng: (cv2.GaussianBlur(image, (0, 0), 16.0), 1.0),
}
#: Images without the tool.
EMPTY = ("empty scenes", "noise", "photographs", "real frames with the tool painted out")
#: All rungs.
RUNGS = ("near", *FAR, "other renderer", "real seq1", "real seq2", *CHANGES, *EMPTY)


def images(rung: str, n: int, *, seed: int = 0, data: Path | None = None) -> Iterator[LabelledImage]:
    """Up to `n` labelled images of a rung; none if its data set is not at hand (`data`: the folder of real data sets).

    Raises `ValueError` for an unknown rung.
    """
    rng = np.random.default_rng([seed, RUNGS.index(rung)] if rung in RUNGS else 0)
    if rung == "near" or rung in CHANGES:
        for labelled in _near(n, seed):
            image, scale = CHANGES[rung](labelled.image, rng) if rung in CHANGES else (labelled.image, 1.0)
            yield labelled._replace(image=image, u=(labelled.u + 0.5) * scale - 0.5)
    elif rung in FAR or rung == "empty scenes":
        for i in range(n):
            image, u, visibility = sample(rng, population="empty" if rung == "empty scenes" else rung, size_px=(1280, 720))
            yield LabelledImage(f"{rung} {i}", image, u, visibility)
    elif rung == "noise":
        for i in range(n):
            yield _empty(f"{rung} {i}", _noise(rng))
    elif rung not in RUNGS:
        raise ValueError(f"rung: {rung!r} is unknown; choose one of {', '.join(RUNGS)}.")
    elif data is not None:
        yield from _from_data(rung, n, Path(data), rng)


def _near(n: int, seed: int) -> Iterator[LabelledImage]:
    """Frames of the shipped recording, and as many of other eyes and tools under the reference rig."""
    recording, half = Recording.open(paths.SHIPPED_RECORDING), n // 2
    own = list(labelled_images(recording, every=max(1, 2 * len(recording.frames) // max(half, 1))))[:half]
    yield from own
    rng = np.random.default_rng([seed, 99])
    for i in range(n - len(own)):
        yield LabelledImage(f"near {i}", *sample(rng, population="near"))


def _empty(name: str, image: np.ndarray) -> LabelledImage:
    return LabelledImage(name, image, np.full((3, 2), np.nan), np.zeros(3, int))


def _noise(rng: np.random.Generator) -> np.ndarray:
    """White or smooth noise of random strength about a random colour."""
    noise = rng.standard_normal((540, 960, 3)).astype(np.float32)
    if rng.random() < 0.7:
        sigma = np.exp(rng.uniform(0, 4))
        noise = cv2.GaussianBlur(noise, (0, 0), sigma) * 3 * sigma
    return np.clip(rng.uniform(30, 200, 3) + rng.uniform(5, 60) * noise, 0, 255).astype(np.uint8)


def _from_data(rung: str, n: int, data: Path, rng: np.random.Generator) -> Iterator[LabelledImage]:
    if rung == "other renderer" and (data / "path_traced" / "truth.json").is_file():
        frames = json.loads((data / "path_traced" / "truth.json").read_text(encoding="utf-8"))["frames"]
        recording = Recording.open(data / "path_traced")
        for i in np.unique(np.linspace(0, len(frames) - 1, min(len(frames), n // 2)).astype(int)):
            for side in ("left", "right"):
                u = np.array(frames[i][side]["u"])
                image = getattr(recording.frames[int(i)], side)
                inside = ((u > -0.5) & (u < np.array(image.shape[1::-1]) - 0.5)).all(1)
                yield LabelledImage(f"{side} {i}", image, u, np.where(inside, 2, 0))
    elif rung == "photographs":
        files = sorted(p for p in (data / "stereo_pairs").rglob("*.png") if "disp" not in p.name)
        for i in range(n if files else 0):
            image = cv2.cvtColor(cv2.imread(str(files[i % len(files)])), cv2.COLOR_BGR2RGB)
            side = int(rng.uniform(0.5, 1.0) * min(image.shape[:2]))
            x, y = (int(rng.integers(0, size - side + 1)) for size in image.shape[1::-1])
            yield _empty(f"{rung} {i}", np.rot90(image[y : y + side, x : x + side], rng.integers(4)).copy())
    elif (data / "retinal_microsurgery").is_dir() and rung != "other renderer":
        for sequence in import_retinal_microsurgery(data / "retinal_microsurgery"):
            if rung.startswith("real seq") and not rung.endswith(sequence.name):
                continue
            for i in np.unique(np.linspace(0, len(sequence) - 1, min(n, len(sequence))).astype(int)):
                image, u = sequence.image(int(i)), sequence.u[i]
                if rung.startswith("real seq"):
                    yield LabelledImage(f"{sequence.name} {i}", image, u, np.where(np.isfinite(u).all(1), 2, 1))
                elif np.isfinite(u).all():
                    yield _empty(f"{sequence.name} {i}", _painted_out(image, u))


def _painted_out(image: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The frame with the jaws and the shaft (an extension behind the base) painted out."""
    mask, ahead = np.zeros(image.shape[:2], np.uint8), u[1:].mean(0) - u[0]
    for start, end in ((u[0], u[1]), (u[0], u[2]), (u[0], u[0] - 20 * ahead)):
        cv2.line(mask, *(tuple(int(v) for v in np.round(p)) for p in (start, end)), 255, 34)
    return cv2.inpaint(image, mask, 5, cv2.INPAINT_TELEA)


def numbers(result: Evaluation) -> dict[str, tuple[float, str]]:
    """The recorded numbers of a rung: name -> (value, unit).

    A landmark is wrong if its error exceeds a fifth of the tool's length.  `nees` and `coverage_95` are computed without the
    wrong ones.
    """
    found, known = result.landmarks, np.isfinite(result.u_true).all(2) | (result.visibility == 0)
    sure = found.confidence >= 0.9
    stated: dict[str, tuple[float, str]] = {"images": (len(found), "")}
    stated["confident"] = (100 * float((found.confidence[known] > 0.5).mean()), "%")
    with np.errstate(invalid="ignore"):
        wrong = ~(result.error_px <= 0.2 * result.length_px[:, None]) & known
    stated["sure"] = (100 * float(sure[known].mean()), "%")
    stated["sure_and_wrong"] = (100 * float(wrong[sure & known].mean()) if (sure & known).any() else 0.0, "%")
    if np.isfinite(result.u_true).any():
        for threshold in (0.01, 0.05, 0.1, 0.2):
            value = pck(found.u, result.u_true, threshold, length_px=result.length_px)
            stated[f"pck_{threshold:g}"] = (float(value), "%")
        scores = asdict(result.scores)
        stated |= {name: (scores[name], unit) for name, unit in (("median_px", "px"), ("p95_px", "px"), ("missed", ""))}
        squared = nees(found.u, np.where(wrong[..., None], np.nan, result.u_true), found.covariance)
        squared = squared[np.isfinite(squared)]
        stated["nees"] = (float(squared.mean()) if squared.size else np.nan, "")
        stated["coverage_95"] = (100 * float((squared <= 5.991).mean()) if squared.size else np.nan, "%")
        stated["confidence_error"] = (result.confidence_error, "")
    return stated


def table(rows: Sequence[tuple[str, dict[str, tuple[float, str]]]]) -> str:
    """A table of the rungs, one in each line, as text."""
    names = list(dict.fromkeys(name for _, row in rows for name in row))
    lines = ["rung".ljust(30) + "".join(name.rjust(17) for name in names)]
    for rung, row in rows:
        lines.append(rung.ljust(30) + "".join(f"{row[n][0]:17.3g}" if n in row else " " * 17 for n in names))
    return "\n".join(lines)
