"""Calibration from rendered frames, as on a real robot: a sweep under the microscope, the detector, the cameras.

Nothing is simulated but the images and the robot's report.  The truth only judges.  Frames are kept in
``data/cache/calibration``, and so are detections, by what made them: the weights, the engine and the detector's code.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lib import correspondences, paths
from lib.calibration import Calibration, calibrate
from lib.cameras import NearAffineCamera, StereoRig
from lib.landmarks.detector import CODE_VERSION, Detector, Landmarks
from lib.landmarks.engines import default_engine
from lib.landmarks.stereo import Correspondences, StereoLandmarks, detect
from lib.recordings import Recording
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE
from notebooks.studies.baselines import perspective_dlt, triangulate_perspective
from notebooks.studies.checkerboard import BoardError, measure_boards

__all__ = [
    "Judgement",
    "board_study",
    "calibrate_labels",
    "calibrate_offsets",
    "detections",
    "detector_study",
    "digest",
    "estimates",
    "judge",
    "label_rows",
    "pooled_over_bound",
    "resolution_study",
    "row_timed",
    "sweep",
    "true_rig",
]

#: The paper's checkerboard was measured with a calibration from 75 frames.
FRAMES = 75
SEED = 75
SHIPPED_WEIGHTS = paths.MODELS / "default.safetensors"
_KEYS = ("u", "covariance", "confidence")


def sweep(distance_mm: float = np.inf, *, frames: int = FRAMES, seed: int = SEED) -> Recording:
    """A calibration sweep of a tool and an eye that no detector has been trained on, rendered (100 CPU s) or from the cache.

    The tool moves at about 2 mm/s, slower than a surgeon's: a robot that calibrates has time.  Seeds differ in tool, eye,
    path and noise; the microscope is the reference rig, affine or `distance_mm` away.
    """
    from lib.simulator import Design, Microscope, simulate

    name = f"sweep-{frames}-frames-{'affine' if np.isinf(distance_mm) else f'{distance_mm:.0f}-mm'}-seed-{seed}"
    folder = paths.CACHE / "calibration" / name
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        microscope = Microscope(inverse_distance_per_mm=1.0 / distance_mm)
        design = Design(microscope=microscope, motion="sweep", duration_s=1.2 * frames)
        simulate(folder, design, seed=seed, n_frames=frames, name=name)
    return Recording.open(folder)


def true_rig(recording: Recording) -> StereoRig:
    """The cameras that rendered a simulated recording; its truth stores the affine ones that touch them.

    Raises
    ------
    ValueError
        If the recording has no truth.
    """
    if recording.truth is None:
        raise ValueError(f"{recording.name}: no truth; only a simulated recording can be judged.")
    rig, inverse = recording.truth.rig, recording.details.get("inverse_distance_per_mm", 0.0)
    if not inverse:
        return rig
    centre = (np.array(recording.image_size_px) - 1) / 2
    return StereoRig(
        *(NearAffineCamera(c.matrix, inverse, centre, ROBOT_FROM_MICROSCOPE.t) for c in (rig.left, rig.right))
    )


def detections(
    recording: Recording,
    weights: str | Path | None = None,
    *,
    beside: Sequence[Path] = (),
    load: Callable[[Path], Callable[[np.ndarray], Landmarks]] = Detector.load,
) -> StereoLandmarks:
    """Landmarks of every frame by the detector in file `weights` (None: the one that ships), from the cache where possible.

    Parameters
    ----------
    beside:
        Other files that the detector is made of.
    load:
        Makes the detector, a function of images (n, h, w, 3), from its file.

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    """
    path = Path(weights) if weights is not None else SHIPPED_WEIGHTS
    made_by = f"{digest(path, *beside)}-{default_engine()}-{CODE_VERSION}"
    stored = paths.CACHE / "calibration" / "detections" / f"{recording.name}-{made_by}.npz"
    if not stored.is_file():
        found = detect(recording, load(path))
        stored.parent.mkdir(parents=True, exist_ok=True)
        partial = stored.with_suffix(".partial.npz")
        np.savez_compressed(
            partial,
            **{f"{side}_{key}": getattr(getattr(found, side), key) for side in ("left", "right") for key in _KEYS},
        )
        partial.replace(stored)
    with np.load(stored) as content:
        left, right = (Landmarks(*(content[f"{side}_{key}"] for key in _KEYS)) for side in ("left", "right"))
    return StereoLandmarks(left, right, recording.landmarks_mm(left.u))


def digest(*files: Path) -> str:
    """Twelve hexadecimal digits that name the content of `files`."""
    total = hashlib.sha256()
    for path in files:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such weights file.")
        total.update(path.read_bytes())
    return total.hexdigest()[:12]


def row_timed(recording: Recording, landmarks: StereoLandmarks, *, min_confidence: float = 0.2) -> Correspondences:
    """Correspondences of a recording with every position taken when its own image row was read ."""
    rows = landmarks.correspondences(min_confidence=min_confidence)
    timed = correspondences.of_recording(recording, landmarks.left.u, landmarks.right.u)
    x, *u = (timed.grid(name) for name in ("x_mm", "u_left", "u_right"))
    at = (rows.frame, rows.landmark)
    good = np.isfinite(x[at]).all(axis=1)
    return replace(rows, x_mm=x[at], u_left=u[0][at], u_right=u[1][at])[good]


def label_rows(recording: Recording, *, click_px: float, seed: int = 0) -> Correspondences:
    """Correspondences from exact landmark pixels with Gaussian click noise, as careful labels would be."""
    truth, rng = recording.truth, np.random.default_rng(seed)
    if truth is None:
        raise ValueError(f"{recording.name}: no truth; only a simulated recording has exact labels.")

    def clicked(u: np.ndarray) -> Landmarks:
        covariance = np.broadcast_to(max(click_px, 1e-3) ** 2 * np.eye(2), (*u.shape, 2))
        return Landmarks(u + rng.normal(0, click_px, u.shape), covariance, np.ones(u.shape[:2]))

    left, right = clicked(truth.u_left), clicked(truth.u_right)
    return row_timed(recording, StereoLandmarks(left, right, recording.landmarks_mm(left.u)))


@dataclass(frozen=True)
class Judgement:
    """A calibration against the truth of a simulated recording.

    The bounds are Cramer-Rao predictions: the covariance of the fitted model's parameters at the true cameras and
    positions of the rows used, for independent Gaussian noise of `sigma_u_px` in every pixel coordinate and of the robot's
    accuracy in every coordinate of a position.

    Attributes
    ----------
    triangulation_um:
        3D RMS of the detected landmarks triangulated, against where they were: detector and calibration.
    calibration_um, calibration_bound_um:
        3D RMS of the true landmarks, from their exact pixels: the calibration's own error; and its bound.
    projection_px, projection_bound_px:
        RMS distance in an image of the true landmarks' projections, over both images; and its bound.  It also sees shifts
        that both images have in common, as a detector makes that is off by some pixels of the tool.
    sigma_u_px:
        RMS error of the used detections per coordinate, measured against truth: noise and bias.
    bias_px:
        (3, 4) mean error of each landmark's used detections, left x, y, right x, y: what does not average out.
    """

    triangulation_um: float
    calibration_um: float
    calibration_bound_um: float
    projection_px: float
    projection_bound_px: float
    sigma_u_px: float
    bias_px: np.ndarray

    @property
    def over_bound(self) -> float:
        """`calibration_um` over its bound."""
        return self.calibration_um / self.calibration_bound_um

    @property
    def projection_over_bound(self) -> float:
        """`projection_px` over its bound."""
        return self.projection_px / self.projection_bound_px


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def judge(calibration: Calibration, recording: Recording, rows: Correspondences) -> Judgement:
    """Compare a calibration of a simulated recording, from correspondences `rows`, with the recording's truth.

    Raises
    ------
    ValueError
        If the recording has no truth.
    """
    rig, truth = true_rig(recording), recording.truth
    at = (rows.frame, rows.landmark)
    good = calibration.inliers
    exact = np.hstack([truth.u_left[at], truth.u_right[at]])
    pair = [exact[:, :2], exact[:, 2:]]
    # The landmarks' positions when their pixels were read, from those pixels and the true rig.
    x = rig.triangulate(*pair).x_mm
    exact = np.hstack(rig.project(x))
    found = calibration.rig.triangulate(rows.u_left, rows.u_right).x_mm
    own = calibration.rig.triangulate(*pair).x_mm
    error = np.hstack([rows.u_left, rows.u_right]) - exact
    sigma_u = float(np.sqrt((error[good] ** 2).mean()))
    ideal = calibrate(
        x[good], [exact[good, :2], exact[good, 2:]], model=calibration.model, sigma_u_px=sigma_u,
        sigma_x_mm=recording.robot_accuracy_mm, ransac_px=np.inf, image_size_px=recording.image_size_px,
    )  # fmt: skip
    points = np.trace(ideal.point_covariance(x, detection=False), axis1=1, axis2=2).mean()
    pixels = np.trace(ideal.projection_covariance(x), axis1=1, axis2=2).mean() / 2
    projected = np.hstack(calibration.rig.project(x)) - exact
    return Judgement(
        triangulation_um=1e3 * _rms((found - x)[good]),
        calibration_um=1e3 * _rms(own - x),
        calibration_bound_um=1e3 * float(np.sqrt(points)),
        projection_px=_rms(projected) / np.sqrt(2),
        projection_bound_px=float(np.sqrt(pixels)),
        sigma_u_px=sigma_u,
        bias_px=np.array([error[good & (rows.landmark == k)].mean(axis=0) for k in range(3)]),
    )


def calibrate_labels(recording: Recording, *, click_px: float = 1.0, seed: int = 0) -> Judgement:
    """`judge` of a calibration from labels with click noise."""
    rows = label_rows(recording, click_px=click_px, seed=seed)
    found = calibrate(rows.x_mm, [rows.u_left, rows.u_right], image_size_px=recording.image_size_px, ransac_px=np.inf)
    return judge(found, recording, rows)


def calibrate_offsets(
    recording: Recording,
    rows: Correspondences,
    *,
    in_images: bool = False,
    own_covariances: bool = False,
    **options: object,
) -> tuple[Calibration, Correspondences]:
    """`calibrate` with offsets of a recording's correspondences; and the rows given."""
    covariance = None
    if own_covariances:
        covariance = np.stack([rows.covariance_px2[:, :2, :2], rows.covariance_px2[:, 2:, 2:]], axis=1)
    data = correspondences.Correspondences.of_points(
        rows.x_mm, rows.u_left, rows.u_right, covariance_px2=covariance, frame=rows.frame, landmark=rows.landmark
    )
    found = calibrate(
        data, offsets="image" if in_images else "tool", image_size_px=recording.image_size_px, **options
    )
    return found, rows


def estimates(
    recording: Recording, landmarks: StereoLandmarks, *, model: str = "zero_skew", seed: int = 0
) -> dict[str, tuple[Calibration, Correspondences]]:
    """Calibrations of one recording, each with the correspondences it was given.

    ``detected`` weighs all detections alike, with the noise measured from the residuals; ``own_covariances`` by the
    detector's covariances; ``tool_offsets`` and ``image_offsets`` estimate constant offsets of the landmarks along
    (`lib.calibration.offsets`), ``offsets_and_covariances`` offsets in the tool's axes with the detector's covariances;
    ``labels_1_px`` is given exact labels with 1 px of click noise instead.  None sees the truth.
    """
    rows = row_timed(recording, landmarks)
    common = {"model": model, "image_size_px": recording.image_size_px, "seed": seed}

    def plain(rows: Correspondences, **options: object) -> tuple[Calibration, Correspondences]:
        return calibrate(rows.x_mm, [rows.u_left, rows.u_right], **common, **options), rows

    found = {"detected": plain(rows), "own_covariances": plain(rows, covariance_px2=rows.covariance_px2)}
    for name, choice in (
        ("tool_offsets", {}),
        ("image_offsets", {"in_images": True}),
        ("offsets_and_covariances", {"own_covariances": True}),
    ):
        fit, used = calibrate_offsets(recording, rows, model=model, seed=seed, **choice)
        found[name] = fit, used
    found["labels_1_px"] = plain(label_rows(recording, click_px=1.0, seed=seed))
    return found


def detector_study(
    seeds: Sequence[int] = (SEED,), *, weights: str | Path | None = None, model: str = "zero_skew"
) -> dict[str, list[Judgement]]:
    """The detector in place of labels: each of `estimates`, judged on the sweeps `seeds`."""
    judged: dict[str, list[Judgement]] = {}
    for seed in seeds:
        recording = sweep(seed=seed)
        for name, (found, rows) in estimates(recording, detections(recording, weights), model=model).items():
            judged.setdefault(name, []).append(judge(found, recording, rows))
    return judged


def pooled_over_bound(judged: Sequence[Judgement]) -> tuple[float, float]:
    """RMS error over RMS bound of several recordings: of triangulated points, and of projections."""
    return tuple(
        float(np.sqrt(sum(getattr(j, error) ** 2 for j in judged) / sum(getattr(j, bound) ** 2 for j in judged)))
        for error, bound in (("calibration_um", "calibration_bound_um"), ("projection_px", "projection_bound_px"))
    )


def board_study(
    distance_mm: float,
    *,
    weights: str | Path | None = None,
    seeds: Sequence[int] = (SEED,),
    boards: int = 4,
    models: Sequence[str] = ("zero_skew", "near_affine"),
) -> dict[str, list[BoardError]]:
    """The paper's second experiment: 0.5 mm checkerboards rendered under the microscope that the tool calibrated.

    Tool frames and boards are rendered alike, landmarks found by the detector, corners by OpenCV.  Returns the errors of
    every model and estimate, ``"zero_skew, detected"`` and so on, one a sweep, all on the same boards; and of the true
    cameras: what the corners alone cost.
    """
    rigs, names = {"true cameras": true_rig(sweep(distance_mm, seed=seeds[0]))}, {"true cameras": ["true cameras"]}
    for seed in seeds:
        recording = sweep(distance_mm, seed=seed)
        landmarks = detections(recording, weights)
        for model in models:
            for name, (found, _) in estimates(recording, landmarks, model=model).items():
                key = f"{model}, {name}"
                rigs[f"{key}, {seed}"] = found.rig
                names.setdefault(key, []).append(f"{key}, {seed}")
    errors = measure_boards(rigs, inverse_distance_per_mm=1.0 / distance_mm, boards=boards, seed=seeds[0])
    return {name: [errors[key] for key in keys] for name, keys in names.items()}


def resolution_study(
    folder: str | Path | None = None, *, seeds: Sequence[int] = (SEED,), training_seed: int = 0
) -> dict[str, dict[str, float]]:
    """The paper's figure: calibration from labels, and from detectors that see the frames at four resolutions.

    Parameters
    ----------
    folder:
        Checkpoints of `notebooks.studies.reduced`; None = where its study keeps them.  What is not trained is left out.
    seeds:
        Sweeps, each calibrated by itself.

    Returns
    -------
    For ``labels`` (1 px of click noise) and each resolution, root mean squares over the sweeps: rows, how many were
    used; sigma_u_px, the detections' error per coordinate; and for the affine cameras and perspective DLT on the same
    rows: triangulation_um of the detected landmarks, calibration_um (exact pixels triangulated) and projection_px, as in
    `Judgement`.
    """
    from notebooks.studies.reduced import RESOLUTIONS, load_resolution

    root = Path(folder) if folder is not None else paths.CACHE / "studies" / "resolution"
    found: dict[str, list[dict[str, float]]] = {"labels": []}
    for seed in seeds:
        recording = sweep(seed=seed)
        found["labels"].append(_affine_and_perspective(recording, label_rows(recording, click_px=1.0)))
        for name in RESOLUTIONS:
            trained = root / name / f"seed{training_seed}"
            if not (trained / "calibration.json").is_file():  # written when the training is done
                continue
            landmarks = detections(
                recording,
                trained / "last.safetensors",
                beside=[SHIPPED_WEIGHTS, trained / "calibration.json"],
                load=lambda _, name=name: load_resolution(name, seed=training_seed, folder=root),
            )
            found.setdefault(name, []).append(_affine_and_perspective(recording, row_timed(recording, landmarks)))
    return {
        name: {key: float(np.sqrt(np.mean([row[key] ** 2 for row in rows]))) for key in rows[0]}
        for name, rows in found.items()
    }


def _affine_and_perspective(recording: Recording, rows: Correspondences) -> dict[str, float]:
    u = [rows.u_left, rows.u_right]
    found = calibrate(rows.x_mm, u, image_size_px=recording.image_size_px)
    judged, good = judge(found, recording, rows), found.inliers
    # Perspective DLT is not robust: it is given the rows that the affine calibration kept.
    pair = [perspective_dlt(rows.x_mm[good], pixels[good]) for pixels in u]
    exact = [side[rows.frame, rows.landmark] for side in (recording.truth.u_left, recording.truth.u_right)]
    x = true_rig(recording).triangulate(*exact).x_mm
    projected = np.hstack([camera.project(x) for camera in pair]) - np.hstack(exact)
    return {
        "rows": int(good.sum()),
        "sigma_u_px": judged.sigma_u_px,
        "affine_triangulation_um": judged.triangulation_um,
        "affine_calibration_um": judged.calibration_um,
        "affine_projection_px": judged.projection_px,
        "perspective_triangulation_um": 1e3 * _rms((triangulate_perspective(pair, u) - x)[good]),
        "perspective_calibration_um": 1e3 * _rms(triangulate_perspective(pair, exact) - x),
        "perspective_projection_px": _rms(projected) / np.sqrt(2),
    }
