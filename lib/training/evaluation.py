"""Evaluating a detector on labelled frames, and calibrating its covariance and confidence on validation frames."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2
from tqdm.auto import tqdm

from lib.correspondences import LANDMARKS
from lib.geometry import image_from_cell
from lib.landmarks.detector import CLOSE, TRACKED_FROM, Detector, Landmarks
from lib.landmarks.error_model import ErrorModel, features_of
from lib.landmarks.heatmaps import DECODERS, decode
from lib.landmarks.metrics import Scores, calibration_error, errors_px, pck, score, tool_length_px
from lib.landmarks.windows import CLOSEUP_REACH_PX, CLOSEUP_ZOOM, expected_in_closeup, map_points
from lib.recordings import Recording

__all__ = ["Evaluation", "calibrate", "compare_decoders", "evaluate", "evaluate_recording", "focus_distance_mm", "main"]

#: Errors beyond this are gross: not what a covariance describes.
GROSS_PX = 20.0
#: What a tool of 2 mm/s moves between two frames at 25 Hz.
TRACKED_SHIFT_PX = 8.0


@dataclass(frozen=True)
class Evaluation:
    """Detections beside their labels.

    Attributes
    ----------
    landmarks:
        What the detector says of n images.
    u_true:
        (n, 3, 2) labels, NaN where there is none (or the landmark is out of the frame).
    visibility:
        (n, 3) 0, 1, 2.
    length_px:
        (n,) the tool's length, the PCK's unit, also where a tip is out of the frame.
    names:
        (n,) which frame each image is, such as ``"left 12"``.
    """

    landmarks: Landmarks
    u_true: np.ndarray
    visibility: np.ndarray
    length_px: np.ndarray
    names: list[str]

    @property
    def scores(self) -> Scores:
        """Over all landmarks."""
        return self._score(np.ones(self.u_true.shape[:2], bool))

    @property
    def error_px(self) -> np.ndarray:
        """(n, 3): infinite where missed, NaN without a label."""
        return errors_px(self.landmarks.u, self.u_true)

    @property
    def correct(self) -> np.ndarray:
        """(n, 3) bool: in view and within 5 % of the tool's length: what confidence is the probability of."""
        return self.error_px <= 0.05 * self.length_px[:, None]

    @property
    def confidence_error(self) -> float:
        """Of confidence as the probability of being `correct`, which no landmark out of view is (`calibration_error`)."""
        known = np.isfinite(self.u_true).all(2) | (self.visibility == 0)
        return calibration_error(self.landmarks.confidence[known], self.correct[known])

    def by_landmark(self) -> dict[str, Scores]:
        """Scores of base, tip_1, tip_2."""
        columns = np.arange(3)
        return {
            name: self._score(np.broadcast_to(columns == k, self.u_true.shape[:2])) for k, name in enumerate(LANDMARKS)
        }

    def by_visibility(self) -> dict[str, Scores]:
        """Scores of visible and of occluded landmarks, where there are any."""
        parts = {"visible": self.visibility == 2, "occluded": self.visibility == 1}
        return {name: self._score(which) for name, which in parts.items() if which.any()}

    def by_depth(
        self, depth_mm: np.ndarray, edges_mm: Sequence[float], landmarks: Sequence[int] = (0, 1, 2)
    ) -> dict[str, Scores]:
        """Scores of `landmarks` by their distance from the focal plane (n, 3) mm, between `edges_mm`; where there are any.

        A tool comes from above, so its base lies further from focus than its tips: they are better told apart.
        """
        asked = np.isin(np.arange(3), landmarks)
        parts = {
            f"{low:g} to {high:g} mm": asked & (np.abs(depth_mm) >= low) & (np.abs(depth_mm) < high)
            for low, high in pairwise(edges_mm)
        }
        return {name: self._score(which) for name, which in parts.items() if (which & (self.visibility > 0)).any()}

    def detection(self, min_confidence: float = 0.5) -> dict[str, float]:
        """Does confidence tell what is there: precision and recall, in percent, of "seen" (above `min_confidence`).

        ``"in_view"``: the landmark lies in the frame, hidden or not.  ``"visible"``: it is not hidden either.
        """
        said = self.landmarks.confidence >= min_confidence
        result: dict[str, float] = {}
        for name, there in (("in_view", self.visibility > 0), ("visible", self.visibility == 2)):
            hit = int((said & there).sum())
            result[f"{name}_precision"] = 100 * hit / int(said.sum()) if said.any() else np.nan
            result[f"{name}_recall"] = 100 * hit / int(there.sum()) if there.any() else np.nan
        return result

    def curve(self, thresholds: np.ndarray) -> np.ndarray:
        """PCK in percent at thresholds (parts of the tool's length)."""
        return pck(self.landmarks.u, self.u_true, thresholds, length_px=self.length_px)

    def worst(self, n: int) -> np.ndarray:
        """Indices of the n images with the largest error."""
        return np.argsort(-np.nan_to_num(self.error_px, nan=-1.0, posinf=1e9).max(1), kind="stable")[:n]

    def _score(self, which: np.ndarray) -> Scores:
        labels = np.where(which[..., None], self.u_true, np.nan)
        return score(self.landmarks.u, labels, self.landmarks.covariance, length_px=self.length_px)


def evaluate(
    detector: Detector, frames: Iterable[tuple[str, np.ndarray, np.ndarray, np.ndarray]], *, progress: bool = False
) -> Evaluation:
    """Run a detector over labelled frames.

    Parameters
    ----------
    frames:
        (name, image (h, w, 3) uint8, u (3, 2) px or NaN, visibility (3,)) of each.

    Raises
    ------
    ValueError
        If there is no frame.
    """
    names, found, labels, visibility, length = [], [], [], [], []
    for name, image, u, v in tqdm(frames, disable=not progress, unit="image"):
        names.append(name)
        found.append(detector(image[None]))
        in_view = np.isfinite(u).all(1) & (np.asarray(v) > 0)
        labels.append(np.where(in_view[:, None], u, np.nan))
        visibility.append(v)
        length.append(tool_length_px(np.asarray(u, dtype=float)[None])[0])
    if not names:
        raise ValueError("frames: no labelled frame to evaluate on.")
    return Evaluation(Landmarks.join(found), np.stack(labels), np.stack(visibility), np.array(length), names)


def labelled_frames(
    recording: Recording, *, every: int = 1
) -> Iterable[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Left and right images of a recording with their labels: the exact truth if simulated, else the annotations.

    Raises
    ------
    ValueError
        If the recording has neither.
    """
    labels = recording.truth or recording.annotations
    if labels is None:
        raise ValueError(f"{recording.name}: neither truth/ nor annotations.json, so there is nothing to compare with.")
    for i in range(0, len(recording.frames), every):
        frame = recording.frames[i]
        yield f"left {i}", frame.left, labels.u_left[i], labels.visibility_left[i]
        yield f"right {i}", frame.right, labels.u_right[i], labels.visibility_right[i]


def focus_distance_mm(recording: Recording, *, every: int = 1) -> np.ndarray:
    """Depth (n, 3) mm of the landmarks beyond the focal plane in a simulated recording, in `labelled_frames`' order.

    Raises
    ------
    ValueError
        If the recording is not simulated.
    """
    from lib.simulator.rig import ROBOT_FROM_MICROSCOPE  # the truth of simulated recordings, for evaluation only

    if recording.truth is None:
        raise ValueError(f"{recording.name}: no truth/, so the distance from focus is not known.")
    x = recording.truth.landmarks_mm[: len(recording.frames) : every]
    z = ROBOT_FROM_MICROSCOPE.inverse().apply(x.reshape(-1, 3))[:, 2].reshape(-1, 3)
    return np.repeat(z, 2, axis=0)


def evaluate_recording(
    detector: Detector, recording: Recording | str | Path, *, every: int = 1, progress: bool = False
) -> Evaluation:
    """`evaluate` on both cameras' images of a recording, every `every`-th frame."""
    recording = recording if isinstance(recording, Recording) else Recording.open(recording)
    return evaluate(detector, labelled_frames(recording, every=every), progress=progress)


def calibrate(
    detector: Detector,
    frames: Iterable[tuple[str, np.ndarray, np.ndarray, np.ndarray]],
    *,
    progress: bool = False,
) -> Detector:
    """The detector with covariance and confidence fitted to its errors on validation frames, never trained on.

    Variances: maximum likelihood of the errors below `GROSS_PX` (of the first stage's below six times that, of the closeups'
    below `CLOSEUP_REACH_PX`), log linear in the peak's features.  The tips, each other's mirror images, share everything.
    Errors have longer tails than a Gaussian: a mean normalised squared error of 2 leaves more than 5 % outside the 95 %
    ellipses, and ellipses that hold 95 % make it less than 2.  The constants stand halfway, for the base and for the tips.
    Of a closeup's correction as much is believed as leaves the smallest errors, which are then centred (`ErrorModel.gain`,
    `bias`); while tracking, all of it.  Tracking is fitted on the same frames, the tool displaced by `TRACKED_SHIFT_PX`,
    every fourth time by five times as much.
    Confidence: logistic regression of "in view and within 5 % of the tool's length" on the same features.

    Parameters
    ----------
    frames:
        As for `evaluate`; easy and hard, since confidence is learnt from failures, and of many tools, since what makes
        errors alike is the tool.

    Raises
    ------
    ValueError
        If too few landmarks are found in them.
    """
    frames = list(frames)
    # What a closeup sees of itself, not what was believed of it so far.
    detector = replace(detector, error_models={k: v for k, v in detector.error_models.items() if k not in CLOSE})
    rough: list[Landmarks] = []
    rng = np.random.default_rng(0)
    for stage in detector.stages:
        features, errors, tolerances, landmark, steps = [], [], [], [], []
        close = stage in CLOSE
        for i, (_, image, u, v) in enumerate(tqdm(frames, disable=not progress, unit="image", desc=stage)):
            in_view = np.isfinite(u).all(1) & (np.asarray(v) > 0)
            labels = np.where(in_view[:, None], u, np.nan)
            tolerance = 0.05 * tool_length_px(np.asarray(u, dtype=float)[None])
            if stage == "frame":
                peaks = detector.frame_peaks(image[None])
                which = np.indices((1, 3)).reshape(2, 3).T
                feature = features_of(peaks.double(), detector.reduction)[0].numpy()
                difference = image_from_cell(peaks.u[0].double().numpy(), detector.reduction) - labels
            else:
                start = rough[i].u
                if close and not (rough[i].confidence >= TRACKED_FROM).all():
                    continue  # nothing is followed from such an image
                if stage == "tracking":
                    # A tool that jumps now and then, which tracking has to notice.
                    moved_px = TRACKED_SHIFT_PX * (5 if rng.random() < 0.25 else 1)
                    before = replace(rough[i], u=start + rng.normal(0, moved_px / np.sqrt(2), (1, 1, 2)))
                    start = detector.refine(image[None], before, stage).u
                peaks, matrices, which = detector.stage_peaks(image[None], start, stage)
                if not len(which):
                    continue
                feature = features_of(peaks.double(), 1)[:, 0].numpy()
                # Errors in the windows' pixels, as the stage's covariance is.
                difference = peaks.u[:, 0].double().numpy() - map_points(matrices, labels[which[:, 1]])
                tolerance = tolerance * np.sqrt(np.abs(np.linalg.det(matrices[:, :, :2])))
                if close:
                    seen = peaks.value[:, 0].numpy() > 0
                    expected = expected_in_closeup(detector.closeup_network.config.size_px, which[:, 1])
                    steps.append((peaks.u[:, 0].double().numpy() - expected)[seen])
                    feature, difference, which, tolerance = (
                        part[seen] for part in (feature, difference, which, tolerance)
                    )
            features.append(feature)
            errors.append(difference)
            landmark.append(which[:, 1])
            tolerances.append(np.broadcast_to(tolerance, len(which)))
        if not features:
            raise ValueError("frames: the detector finds nothing in them to calibrate on; give other frames.")
        feature, error, tolerance, which = (np.concatenate(part) for part in (features, errors, tolerances, landmark))
        gross = {
            "frame": 6 * GROSS_PX,
            "tool": 2 * GROSS_PX / detector.tool_reduction,
            "window": GROSS_PX,
            "closeup": CLOSEUP_REACH_PX * min(CLOSEUP_ZOOM),
            "tracking": CLOSEUP_REACH_PX * min(CLOSEUP_ZOOM),
        }[stage]
        gain, bias = np.ones((3, 2)), np.zeros((3, 2))
        if close:
            # While tracking the place where a landmark is expected is an old one, which is evidence of nothing.
            gains = [1.0] if stage == "tracking" else np.linspace(0, 1, 51)
            moved = np.concatenate(steps)
            gain, bias = _belief(moved, error, which, gross, gains)
            error = error + (gain[which] - 1) * moved - bias[which]
        with np.errstate(invalid="ignore"):
            correct = np.linalg.norm(error, axis=1) <= tolerance
        fit = _fit(feature, error, correct, which, gross)
        fit = ErrorModel.of(fit.log_variance, fit.logit, gain.tolist(), bias.tolist())
        detector = detector.with_error_models(**{stage: fit})
        # What the next stage starts from.
        if stage == "frame":
            rough = [detector.coarse(f[1][None]) for f in frames]
        elif stage != "tracking":
            rough = [detector.refine(f[1][None], r, stage) for f, r in zip(frames, rough, strict=True)]
    return detector


def compare_decoders(
    detector: Detector, frames: Iterable[tuple[str, np.ndarray, np.ndarray, np.ndarray]], *, seed: int = 0
) -> dict[str, np.ndarray]:
    """Errors (m,) px of every decoder on the same heatmaps: those of the windows, off by up to 2 px.

    Without the small shift every landmark would lie between four cells, which favours some decoders.
    """
    if detector.window_network is None:
        raise ValueError("detector: has no window stage, whose heatmaps the decoders are compared on.")
    rng = np.random.default_rng(seed)
    errors: dict[str, list[np.ndarray]] = {method: [] for method in DECODERS}
    for _, image, u, v in frames:
        labels = np.where((np.isfinite(u).all(1) & (np.asarray(v) > 0))[:, None], u, np.nan)
        near = detector(image[None]).u + rng.uniform(-2, 2, (1, 3, 2))
        windows, matrices, which = detector.windows(image[None], near, "window")
        if not len(which):
            continue
        heatmaps = detector.outputs(windows, "window")[np.arange(len(which)), which[:, 1]][:, None]
        true = map_points(matrices, labels[which[:, 1]])
        for method in DECODERS:
            found = decode(heatmaps, detector.window_network.stride, method=method).u[:, 0].double().numpy()
            errors[method].append(np.linalg.norm(found - true, axis=1))
    return {method: np.concatenate(values) if values else np.zeros(0) for method, values in errors.items()}


def _fit(
    features: np.ndarray, errors: np.ndarray, correct: np.ndarray, landmark: np.ndarray, gross_px: float
) -> ErrorModel:
    """Fit to m peaks: features (m, 3, 4), errors (m, 2), correct (m,), and which landmark each is, (m,)."""
    size = np.linalg.norm(errors, axis=1)
    use = np.isfinite(size) & (size < gross_px)
    if use.sum() < 20:
        raise ValueError(f"frames: only {use.sum()} landmarks to calibrate on; give at least 20.")
    tip = landmark[use, None] > 0

    def variance(axis: int) -> tuple[float, ...]:
        squared = errors[use, axis] ** 2
        x = np.column_stack([~tip, tip, features[use, axis, 1:]]).astype(float)

        def deviance(beta: np.ndarray) -> tuple[float, np.ndarray]:
            log_variance = x @ beta
            ratio = squared * np.exp(-log_variance)
            slopes = 1e-3 * np.array([0.0, 0.0, 1.0, 1.0, 1.0])
            value = (log_variance + ratio).mean() + slopes @ beta**2
            return value, x.T @ (1 - ratio) / len(x) + 2 * slopes * beta

        start = np.array([np.log(max(squared.mean(), 1e-6))] * 2 + [0.0] * 3)
        base, tips, *slopes = map(float, minimize(deviance, start, jac=True, method="L-BFGS-B").x)
        return (base, tips, tips, *slopes)

    y, both = correct.astype(float), features[:, 2]

    def cost(beta: np.ndarray) -> tuple[float, np.ndarray]:
        z = both @ beta
        ridge = 1e-3 * np.array([0.0, 1.0, 1.0, 1.0])
        p = 1 / (1 + np.exp(-z))
        return (np.logaddexp(0, z) - y * z).mean() + ridge @ beta**2, both.T @ (p - y) / len(y) + 2 * ridge * beta

    logit = minimize(cost, np.array([-4.0, 0.0, 8.0, 0.0]), jac=True, method="L-BFGS-B").x
    log_variance = np.array([variance(0), variance(1)])
    rows = ErrorModel(tuple(map(tuple, log_variance.tolist()))).coefficients[landmark[use]]
    squared = (errors[use] ** 2 / np.exp((rows * features[use, :2]).sum(-1))).sum(1)
    for own, columns in ((~tip[:, 0], np.s_[:1]), (tip[:, 0], np.s_[1:3])):
        if own.any():
            log_variance[:, columns] += 0.5 * np.log(np.quantile(squared[own], 0.95) / chi2.ppf(0.95, 2))
    return ErrorModel(tuple(map(tuple, log_variance.tolist())), tuple(map(float, logit)))


def _belief(
    moved: np.ndarray, errors: np.ndarray, landmark: np.ndarray, gross_px: float, gains: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Gain, one of `gains`, and bias (3, 2) of the base and the tips along each axis that leave the smallest absolute errors.

    `moved` (m, 2) are the closeups' whole corrections, `errors` (m, 2) what they leave.
    """
    # What was expected must be near the landmark; a closeup's own blunders count.
    use = np.linalg.norm(errors - moved, axis=1) < gross_px
    best, bias = np.ones((3, 2)), np.zeros((3, 2))
    for k, axis in product(([0], [1, 2]), (0, 1)):  # the base, and both tips
        own = use & np.isin(landmark, k)
        if not own.any():
            continue
        left = errors[own, axis] + (np.asarray(gains)[:, None] - 1) * moved[own, axis]
        centre = np.median(left, axis=1)
        i = np.abs(left - centre[:, None]).mean(1).argmin()
        best[k, axis], bias[k, axis] = gains[i], centre[i]
    return best, bias


def main(argv: list[str] | None = None) -> int:
    """`python3 -m lib evaluate`: a weights file on a recording; prints the scores, and writes them as JSON on request."""
    parser = argparse.ArgumentParser(prog="python3 -m lib evaluate", description=main.__doc__.split(": ", 1)[1])
    parser.add_argument("recording", type=Path, help="folder of a recording with truth/ or annotations.json")
    parser.add_argument(
        "--weights", default=None, help="weights file or name in data/models (default: the shipped ones)"
    )
    parser.add_argument("--every", type=int, default=1, help="evaluate every N-th frame")
    parser.add_argument("--json", type=Path, help="write the scores here")
    arguments = parser.parse_args(argv)
    if arguments.every < 1:
        parser.error("--every: must be at least 1.")
    try:
        result = evaluate_recording(
            Detector.load(arguments.weights), arguments.recording, every=arguments.every, progress=True
        )
    except (ValueError, FileNotFoundError) as error:
        print(error, file=sys.stderr)
        return 2
    rows = {"all": result.scores} | result.by_landmark() | result.by_visibility()
    print(
        f"{'':10}{'PCK@0.01':>10}{'PCK@0.05':>10}{'PCK@0.10':>10}{'median px':>11}{'95 % px':>9}{'missed':>8}{'labels':>8}"
    )
    for name, s in rows.items():
        print(
            f"{name:10}{s.pck_0_01:10.1f}{s.pck_0_05:10.1f}{s.pck_0_10:10.1f}{s.median_px:11.2f}{s.p95_px:9.2f}"
            f"{s.missed:8d}{s.labels:8d}"
        )
    s = result.scores
    print(f"normalised squared error {s.nees:.2f} (2 is right), 95 % ellipses hold {s.coverage_95:.1f} %")
    print(f"bias {s.bias_px[0]:+.2f}, {s.bias_px[1]:+.2f} px")
    seen = ", ".join(f"{name.replace('_', ' ')} {value:.1f} %" for name, value in result.detection().items())
    print(f"confidence above 0.5 means seen: {seen}")
    if arguments.json:
        arguments.json.write_text(
            json.dumps({k: v.as_dict() for k, v in rows.items()}, indent=1) + "\n", encoding="utf-8"
        )
    return 0
