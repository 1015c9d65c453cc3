"""How much simulated images are like real ones: image statistics, and a preset that mimics the public in-vivo frames.

The public frames with forceps (Sznitman et al., MICCAI 2012) come from another set-up than the open-sky one: a
640 x 480 video camera looks through the pupil at a fifth of the magnification, under a blue or a green endoilluminator.
`in_vivo_window` renders that, so that statistics can be compared like with like.  Its light, blur and noise were set
by hand on these very frames: the comparison shows that the renderer can reach them, not that it predicts them.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np

from lib.cameras import AffineCamera
from lib.geometry import RigidTransform
from lib.recordings import import_retinal_microsurgery
from lib.simulator.eye import Eye
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.microscope import Microscope
from lib.simulator.render import render_view

__all__ = [
    "STATISTICS",
    "compare",
    "image_statistics",
    "in_vivo_window",
    "landmark_window",
    "real_windows",
    "statistics_table",
]

#: name -> what it is.
STATISTICS = {
    "luminance_mean": "mean luminance, 0 to 1",
    "luminance_std": "standard deviation of luminance",
    "luminance_p05": "5th percentile of luminance",
    "luminance_p95": "95th percentile of luminance",
    "red_over_green": "mean red over mean green",
    "blue_over_green": "mean blue over mean green",
    "saturated_share": "share of pixels with a channel above 250",
    "gradient_mean": "mean gradient of luminance, 1/px",
    "gradient_kurtosis": "excess kurtosis of the horizontal derivative (edges among smooth areas)",
    "spectrum_slope": "slope of log power over log frequency, 1/32 to 1/4 cycles/px",
    "sharpness_centre": "mean |Laplacian| of the central ninth",
    "sharpness_border": "mean |Laplacian| of the rest",
}


def image_statistics(image: np.ndarray) -> dict[str, float]:
    """The `STATISTICS` of an image (h, w, 3) uint8 RGB."""
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 33:
        raise ValueError(f"image: expected (h, w, 3) of at least 33 x 33 px, got {image.shape}.")
    rgb = image.astype(np.float32) / 255
    grey = rgb @ np.array([0.299, 0.587, 0.114], np.float32)
    height, width = grey.shape
    d_x, d_y = np.diff(grey, axis=1)[:-1], np.diff(grey, axis=0)[:, :-1]
    side = min(height, width)
    window = np.outer(np.hanning(side), np.hanning(side))
    patch = grey[(height - side) // 2 :, (width - side) // 2 :][:side, :side]
    power = np.abs(np.fft.fft2((patch - patch.mean()) * window)) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    edges = np.geomspace(1 / 32, 1 / 4, 9)
    rings = [(frequency >= low) & (frequency < high) for low, high in itertools.pairwise(edges)]
    means = np.array([power[ring].mean() for ring in rings])
    laplacian = np.abs(cv2.Laplacian(grey, cv2.CV_32F))
    central = np.zeros(grey.shape, bool)
    central[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = True
    red, green, blue = rgb.reshape(-1, 3).mean(axis=0)
    spread = d_x - d_x.mean()
    return {
        "luminance_mean": float(grey.mean()),
        "luminance_std": float(grey.std()),
        "luminance_p05": float(np.percentile(grey, 5)),
        "luminance_p95": float(np.percentile(grey, 95)),
        "red_over_green": float(red / max(green, 1e-6)),
        "blue_over_green": float(blue / max(green, 1e-6)),
        "saturated_share": float((image > 250).any(axis=2).mean()),
        "gradient_mean": float(np.hypot(d_x, d_y).mean()),
        "gradient_kurtosis": float((spread**4).mean() / max((spread**2).mean() ** 2, 1e-20) - 3),
        "spectrum_slope": float(
            np.polyfit(np.log(np.sqrt(edges[:-1] * edges[1:])), np.log(np.maximum(means, 1e-12)), 1)[0]
        ),
        "sharpness_centre": float(laplacian[central].mean()),
        "sharpness_border": float(laplacian[~central].mean()),
    }


def landmark_window(image: np.ndarray, u: np.ndarray, size_px: int = 96) -> np.ndarray:
    """The square of an image round the mean of its known landmarks u (3, 2), moved inside where it sticks out."""
    centre = np.nanmean(u, axis=0)
    if not np.isfinite(centre).all():
        raise ValueError("u: no landmark is known; choose a labelled frame.")
    corner = np.clip(np.round(centre - size_px / 2), 0, np.array(image.shape[1::-1]) - size_px).astype(int)
    return image[corner[1] : corner[1] + size_px, corner[0] : corner[0] + size_px]


def in_vivo_window(rng: np.random.Generator, size_px: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """A window of a simulated in-vivo frame round the jaws, and its landmarks u (3, 2) px.

    Rendered at three times the resolution: 18 px per mm, a pale fundus under coloured light whose hot spot lies near
    the tool, glare of the optics, and the sensor's sharpening and noise.
    """
    green = rng.random() < 0.5
    fine, zoom = 3, 18.0 * rng.uniform(0.85, 1.15)
    eye = Eye(seed=int(rng.integers(40, 46)), texture_px=768, radius_mm=13.0, depth_mm=3.0, gloss=0.7 if green else 0.3)
    forceps = Forceps(
        shaft_radius_mm=0.36,
        jaw_length_mm=rng.uniform(2.0, 2.6),
        jaw_radius_mm=0.16,
        bow_mm=rng.uniform(0.15, 0.4),
        brightness=0.75 if green else 0.22,
        tip_radius_mm=0.015,
    )
    place = rng.normal(0, 2.5, 2)
    pose = Pose(
        (float(place[0]), float(place[1]), -0.8),
        azimuth_rad=rng.uniform(-np.pi, np.pi),
        pitch_rad=rng.uniform(0.15, 0.5),
        roll_rad=float(np.clip(rng.normal(0, 0.3), -0.9, 0.9)),
        opening_mm=rng.uniform(0.1, 1.2),
    )
    # Colours are those of the light and of the camera: the mean of the picture, not of the eye, is what is known.
    target = np.array([0.76, 1.0, 0.56] if green else [0.72, 1.0, 1.30]) * np.exp(rng.normal(0, 0.03, 3))
    mean = (eye.texture.reshape(-1, 3)[::97] / 255.0).mean(axis=0)
    gain = (target / target[1] / (mean / mean[1])) ** 2.2
    gain = tuple(float(v) for v in gain * (0.50 / (mean[1] ** 2.2)))
    microscope = Microscope(
        depth_of_field_mm=rng.uniform(1.5, 4.0),
        psf_px=3.0,
        light_slope=tuple(float(v) for v in rng.uniform(-1.2, 1.2, 2)),
        spot_mm=tuple(float(v) for v in place + rng.normal(0, 1.6, 2)),
        spot_radius_mm=rng.uniform(1.6, 3.5),
        brightness=float(np.exp(rng.normal(-0.15, 0.3))),
        vignetting=0.0,
        gain=(gain, gain),
        full_well=2500.0,
        read_noise=8.0,
    )
    R = RigidTransform.from_rotation_vector((0.0, rng.normal(0, 0.05), rng.uniform(-np.pi, np.pi))).R
    middle = R[:2] @ forceps.landmarks(pose).mean(axis=0)
    n = fine * size_px
    camera = AffineCamera(np.column_stack([fine * zoom * R[:2], (n - 1) / 2 - fine * zoom * middle]))
    view = render_view(eye, microscope, camera, (n, n), forceps=forceps, pose=pose, rng=rng)
    image = cv2.resize(view.image, (size_px, size_px), interpolation=cv2.INTER_AREA)
    image = cv2.addWeighted(image, 1.4, cv2.GaussianBlur(image, (0, 0), 1.2), -0.4, 0)
    return image, (view.u + 0.5) / fine - 0.5


def statistics_table(windows: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Statistic -> its values (n,) over images."""
    if not windows:
        raise ValueError("windows: no image to take statistics of.")
    rows = [image_statistics(window) for window in windows]
    return {name: np.array([row[name] for row in rows]) for name in STATISTICS}


def compare(real: dict[str, np.ndarray], simulated: dict[str, np.ndarray]) -> list[dict[str, float | str | bool]]:
    """One row a statistic: the real 5th, 50th and 95th percentile, the simulated median, and whether it lies within."""
    rows = []
    for name, values in real.items():
        low, middle, high = np.percentile(values, [5, 50, 95])
        median = float(np.median(simulated[name]))
        rows.append(
            {
                "statistic": STATISTICS[name],
                "real_p05": float(low),
                "real_median": float(middle),
                "real_p95": float(high),
                "simulated_median": median,
                "within": bool(low <= median <= high),
            }
        )
    return rows


def real_windows(folder: str | Path, n: int, size_px: int = 96) -> list[np.ndarray]:
    """Windows round the tool of about `n` real frames, evenly from each sequence of the public in-vivo data."""
    windows = []
    sequences = import_retinal_microsurgery(folder)
    for sequence in sequences:
        known = np.flatnonzero(np.isfinite(sequence.u).all(axis=2).any(axis=1))
        for k in known[np.linspace(0, len(known) - 1, max(n // len(sequences), 1)).astype(int)]:
            windows.append(landmark_window(sequence.image(int(k)), sequence.u[k], size_px))
    return windows
