"""How similar are simulated and real images?  Image statistics, and presets that imitate the public in-vivo frames.

The public frames with forceps (Sznitman et al., MICCAI 2012) come from another set-up than our open-sky one: a 640 x 480
video camera looks through the pupil at a fifth of the magnification.  The first sequence is lit by a blue endoilluminator,
the second by a green one.  `in_vivo_window` renders that set-up, so that the comparison is fair.  Light, blur and noise of
the presets (`LIGHTS`) were set by hand on the first half of each sequence and are judged on the second half.  So the
comparison shows that the renderer can produce such frames; it does not show that it can imitate an unknown microscope.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lib.cameras import AffineCamera
from lib.geometry import RigidTransform
from lib.recordings import read_image
from lib.simulator.eye import Eye, Ground
from lib.simulator.families import TOOLS
from lib.simulator.forceps import Forceps, Pose
from lib.simulator.render import render_view
from lib.simulator.rig import Microscope
from lib.simulator.texture import EXTENT_MM, fundus_texture
from lib.simulator.window import Window
from notebooks.studies.retinal import import_retinal_microsurgery

#: name -> description.
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
#: Statistic -> what determines it in the simulator, and so may cause a difference from real images.
_EXPOSURE = "the exposure, which changes in a sequence with every motion of its lamp; the preset draws it from one range"
_DETAIL = "blur, sharpening and noise of the camera, one value in each preset, while focus changes within a sequence"
SET_BY = {
    "luminance_mean": _EXPOSURE,
    "luminance_std": "the hot spot of the lamp and the brightness of the tool against the retina",
    "luminance_p05": "tool and shadow, and in real images the border of the lit field, which is not simulated",
    "luminance_p95": _EXPOSURE,
    "red_over_green": "the colour of the lamp, and of the tissue near the tool",
    "blue_over_green": "the colour of the lamp, and of the tissue near the tool",
    "saturated_share": _EXPOSURE + "; white membranes that saturate near the tool have no counterpart here",
    "gradient_mean": _DETAIL,
    "gradient_kurtosis": "few strong edges: tool, vessels and glints, whose share of a window is fixed by the preset",
    "spectrum_slope": _DETAIL,
    "sharpness_centre": _DETAIL,
    "sharpness_border": _DETAIL,
}
#: The same for `fundus_windows`.
FUNDUS_SET_BY = dict.fromkeys(
    STATISTICS,
    "grain and blotches of the pigment, which are stronger than in the photograph, and not blurred by optics",
) | {
    name: "the pigment drawn for an eye, and the photograph's own exposure and colour"
    for name in (
        "luminance_mean",
        "luminance_std",
        "luminance_p05",
        "luminance_p95",
        "red_over_green",
        "blue_over_green",
        "saturated_share",
    )
}


@dataclass(frozen=True)
class Light:
    """Parameters of an endoilluminator and its camera, set by hand on the first half of one real sequence.

    Attributes
    ----------
    colour:
        Mean red, green and blue of an image, divided by its mean green.
    exposure, exposure_spread:
        Median green in linear light, and the standard deviation of its logarithm over images.
    metal, gloss:
        Reflectance of the tool, and strength of the wet surface's reflection.
    spot_distance_mm, spot_radius_mm:
        Ranges of the hot spot's distance from the jaws, and of its Gaussian radius.
    psf_px, sharpening, noise:
        Blur in px at three times the resolution, strength of the camera's unsharp mask, and shot noise at full scale.
    veil:
        Share of the light that vitreous and optics scatter, which blurs it.
    contrast:
        Exponent of the camera's tone curve about the median; 1 = none.
    """

    colour: tuple[float, float, float]
    exposure: float
    exposure_spread: float
    metal: float
    gloss: float
    spot_distance_mm: tuple[float, float]
    spot_radius_mm: tuple[float, float]
    psf_px: float
    sharpening: float
    noise: float
    veil: float
    contrast: float


#: Name of a sequence -> the preset that was set on its first half.
LIGHTS = {
    "seq1": Light((0.70, 1.0, 1.30), 0.26, 0.25, 0.03, 0.4, (1.2, 3.5), (0.8, 1.5), 2.4, 0.9, 0.004, 0.45, 1.0),
    "seq2": Light((0.755, 1.0, 0.55), 0.41, 0.15, 0.33, 0.4, (1.5, 3.0), (1.2, 2.0), 2.6, 0.8, 0.015, 0.18, 1.35),
}


def image_statistics(image: np.ndarray) -> dict[str, float]:
    """The `STATISTICS` of an image (h, w, 3) uint8 RGB."""
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 33:
        raise ValueError(f"image: expected (h, w, 3) of at least 33 x 33 px, got {image.shape}.")
    rgb = image.astype(np.float32) / 255
    grey = _luminance(image)
    height, width = grey.shape
    d_x, d_y = np.diff(grey, axis=1)[:-1], np.diff(grey, axis=0)[:, :-1]
    frequency, power = _power(grey)
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


def _luminance(image: np.ndarray) -> np.ndarray:
    """The luminance (h, w) float32, 0 to 1, of an image (h, w, 3) uint8 RGB."""
    return image.astype(np.float32) / 255 @ np.array([0.299, 0.587, 0.114], np.float32)


def _power(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frequency (cycles per px) and power, (side, side) each, of the central square under a Hann window."""
    height, width = grey.shape
    side = min(height, width)
    window = np.outer(np.hanning(side), np.hanning(side))
    patch = grey[(height - side) // 2 :, (width - side) // 2 :][:side, :side]
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    return frequency, np.abs(np.fft.fft2((patch - patch.mean()) * window)) ** 2


def landmark_window(image: np.ndarray, u: np.ndarray, size_px: int = 96) -> np.ndarray:
    """The square of an image around the mean of its known landmarks u (3, 2), moved so that it lies inside the image."""
    centre = np.nanmean(u, axis=0)
    if not np.isfinite(centre).all():
        raise ValueError("u: no landmark is known; choose a labelled frame.")
    corner = np.clip(np.round(centre - size_px / 2), 0, np.array(image.shape[1::-1]) - size_px).astype(int)
    return image[corner[1] : corner[1] + size_px, corner[0] : corner[0] + size_px]


def in_vivo_window(
    rng: np.random.Generator, size_px: int = 96, light: str | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """A window of a simulated in-vivo frame around the jaws, and its landmarks u (3, 2) px.

    It shows 18 px per mm and is rendered at three times the resolution: a pale fundus under one of the coloured `LIGHTS`,
    whose hot spot lies near the tool, with glare of the optics, sharpening and noise.

    Parameters
    ----------
    light:
        One of `LIGHTS`; None draws one.
    """
    if light is not None and light not in LIGHTS:
        raise ValueError(f"light: unknown {light!r}; one of {', '.join(LIGHTS)}.")
    lamp = LIGHTS[light or str(rng.choice(list(LIGHTS)))]
    fine, zoom = 3, 18.0 * rng.uniform(0.85, 1.15)
    eye = Eye(seed=int(rng.integers(40, 46)), texture_px=768, radius_mm=13.0, depth_mm=3.0, gloss=lamp.gloss)
    forceps = Forceps(
        shaft_radius_mm=0.36,
        jaw_length_mm=rng.uniform(2.0, 2.6),
        jaw_radius_mm=0.16,
        bow_mm=rng.uniform(0.15, 0.4),
        brightness=lamp.metal,
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
    away = rng.uniform(-np.pi, np.pi)
    spot = place + rng.uniform(*lamp.spot_distance_mm) * np.array([np.cos(away), np.sin(away)])
    microscope = Microscope(
        depth_of_field_mm=rng.uniform(1.5, 4.0),
        psf_px=lamp.psf_px,
        light_slope=tuple(float(v) for v in rng.uniform(-1.2, 1.2, 2)),
        spot_mm=tuple(float(v) for v in spot),
        spot_radius_mm=rng.uniform(*lamp.spot_radius_mm),
        brightness=1.0,
        vignetting=0.0,
        gain=((1.0, 1.0, 1.0),) * 2,
        full_well=float("inf"),
    )
    R = RigidTransform.from_rotation_vector((0.0, rng.normal(0, 0.05), rng.uniform(-np.pi, np.pi))).R
    middle = R[:2] @ forceps.landmarks(pose).mean(axis=0)
    n = fine * size_px
    camera = AffineCamera(np.column_stack([fine * zoom * R[:2], (n - 1) / 2 - fine * zoom * middle]))
    view = render_view(eye, microscope, Window(camera, (n, n)), forceps=forceps, pose=pose)
    # Under a narrow-band lamp the image has little of the fundus's own colour and mostly the lamp's.
    linear = cv2.resize((view.image / 255.0) ** 2.2, (size_px, size_px), interpolation=cv2.INTER_AREA)
    linear += lamp.veil * (cv2.GaussianBlur(linear, (0, 0), 0.1 * size_px) - linear)
    grey = linear @ np.array([0.25, 0.6, 0.15])
    own = linear / np.maximum(linear.reshape(-1, 3).mean(axis=0), 1e-6) * grey.mean()
    colour = np.array(lamp.colour) * np.exp(rng.normal(0, 0.03, 3))
    tone = (grey / np.median(grey)) ** (lamp.contrast - 1)
    tinted = (0.35 * own + 0.65 * grey[..., None]) * colour**2.2 * tone[..., None]
    exposed = tinted * (lamp.exposure * np.exp(rng.normal(0, lamp.exposure_spread)) / np.median(tinted[..., 1]))
    noisy = exposed + rng.normal(0, 1, exposed.shape) * np.sqrt(exposed * lamp.noise**2 + 1e-6)
    image = np.clip(noisy, 0, 1) ** (1 / 2.2)
    image = image + lamp.sharpening * (image - cv2.GaussianBlur(image, (0, 0), 1.2))
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), (view.u + 0.5) / fine - 0.5


def tool_windows(size_px: int = 360, seed: int = 5) -> dict[str, np.ndarray]:
    """One image of each family of tools, with its landmarks: cross = base, ring = tip 1, square = tip 2."""
    rng, images = np.random.default_rng(seed), {}
    microscope = Microscope(depth_of_field_mm=float("inf"), full_well=float("inf"), vignetting=0.0, gain=((1.0,) * 3,) * 2)
    scene = Ground(kind="smooth", colours=((0.45, 0.45, 0.45), (0.55, 0.55, 0.55)), gloss=0.0, depth_mm=0.0)
    camera = microscope.rig(RigidTransform.identity()).left
    for family, draw in TOOLS.items():
        tool = draw(rng, 0.8)
        long = tool.jaw_length_mm
        pose = Pose((-0.5 * long, 0.0, -1.5), 0.3, 0.15, 0.2, 0.5 * long)
        window = Window.around(camera, camera.project(np.array([[0.0, 0.0, -1.5]]))[0], (size_px, size_px))
        view = render_view(scene, microscope, window, forceps=tool, pose=pose, factor=4)
        image = view.image.copy()
        base, tip_1, tip_2 = (tuple(int(v) for v in np.round(u)) for u in view.u)
        cv2.drawMarker(image, base, (220, 20, 20), cv2.MARKER_CROSS, 22, 2, cv2.LINE_AA)
        cv2.circle(image, tip_1, 9, (0, 90, 220), 2, cv2.LINE_AA)
        cv2.rectangle(image, (tip_2[0] - 8, tip_2[1] - 8), (tip_2[0] + 8, tip_2[1] + 8), (0, 130, 60), 2)
        images[family.replace("_", " ")] = image
    return images


def statistics_table(windows: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Statistic -> its values (n,) over images."""
    if not windows:
        raise ValueError("windows: no image to take statistics of.")
    rows = [image_statistics(window) for window in windows]
    return {name: np.array([row[name] for row in rows]) for name in STATISTICS}


def compare(real: dict[str, np.ndarray], simulated: dict[str, np.ndarray]) -> list[dict[str, float | str | bool]]:
    """A row for each statistic: percentiles of both (5, 50, 95); `within`: the simulated median is in this range."""
    rows = []
    for name, values in real.items():
        row = {"name": name, "statistic": STATISTICS[name]}
        for kind, of_kind in (("real", values), ("simulated", simulated[name])):
            for percentile, value in zip(("p05", "median", "p95"), np.percentile(of_kind, [5, 50, 95]), strict=True):
                row[f"{kind}_{percentile}"] = float(value)
        row["within"] = bool(row["real_p05"] <= row["simulated_median"] <= row["real_p95"])
        rows.append(row)
    return rows


def exceptions(rows: list[dict[str, float | str | bool]], set_by: Mapping[str, str] = SET_BY) -> list[str]:
    """A line for each statistic outside the limits of `compare`: its value, the limit, and what determines it.

    `set_by` has what determines each statistic; the default is for `in_vivo_window`, `FUNDUS_SET_BY` for bare textures.
    """
    lines = []
    for r in rows:
        if not r["within"]:
            above = r["simulated_median"] > r["real_p95"]
            limit = f"{'above' if above else 'below'} the real {'95th' if above else '5th'} percentile"
            lines.append(
                f"{r['statistic']}: simulated {r['simulated_median']:.3g}, {limit} "
                f"{r['real_p95' if above else 'real_p05']:.3g}. Set by {set_by[r['name']]}."
            )
    return lines


def real_windows(folder: str | Path, n: int, size_px: int = 96, part: str = "judged") -> dict[str, list[np.ndarray]]:
    """Windows around the tool in about `n` real frames of the public in-vivo data: sequence -> windows.

    Parameters
    ----------
    part:
        "tuned": frames of the first half of each sequence, on which `LIGHTS` was set; "judged": those of the second half.
    """
    if part not in ("tuned", "judged"):
        raise ValueError(f"part: 'tuned' or 'judged', got {part!r}.")
    windows = {}
    sequences = import_retinal_microsurgery(folder)
    for sequence in sequences:
        known = np.flatnonzero(np.isfinite(sequence.u).all(axis=2).any(axis=1))
        known = known[: len(known) // 2] if part == "tuned" else known[len(known) // 2 :]
        chosen = known[np.linspace(0, len(known) - 1, max(n // len(sequences), 1)).astype(int)]
        windows[sequence.name] = [landmark_window(sequence.image(int(k)), sequence.u[k], size_px) for k in chosen]
    return windows


def fundus_windows(photograph: str | Path, seeds: Sequence[int], n: int, size_px: int = 160) -> tuple[list, list]:
    """Windows (real, simulated), n each, from a fundus photograph and from procedural textures, at 40 px per mm.

    A square photograph of 45 degrees is assumed to show 13 mm of retina; the black surround is left out.

    Raises
    ------
    ValueError
        If the photograph is not square, or the windows do not fit into the 12 mm that are used.
    """
    rng = np.random.default_rng(0)
    picture = read_image(Path(photograph))
    height, width = picture.shape[:2]
    if abs(width - height) > 0.02 * height:
        raise ValueError(
            f"{photograph}: {width} x {height} px, expected a square; crop it to the disc, whose width gives the scale."
        )
    if size_px > 6.0 * 40 * np.sqrt(2):
        raise ValueError(f"size_px: a window of {size_px} px does not fit; at most {int(6.0 * 40 * np.sqrt(2))}.")
    across = round(13.0 * 40)
    shown = cv2.resize(picture, (across, across), interpolation=cv2.INTER_AREA)
    textures = [fundus_texture(int(seed), round(EXTENT_MM * 40)) for seed in seeds]
    pairs = []
    for images in ([shown], textures):
        windows = []
        for k in range(n):
            image = images[k % len(images)]
            # The corners of the window stay within 6 mm of the middle, inside the visible disc.
            radius = (6.0 * 40 - size_px / np.sqrt(2)) * np.sqrt(rng.random())
            angle = rng.uniform(0, 2 * np.pi)
            corner = np.array(image.shape[1::-1]) / 2 + radius * np.array([np.cos(angle), np.sin(angle)]) - size_px / 2
            x, y = np.round(corner).astype(int)
            windows.append(image[y : y + size_px, x : x + size_px])
        pairs.append(windows)
    return pairs[0], pairs[1]


@dataclass(frozen=True)
class Profiles:
    """Distributions of n images, one image a row.

    Attributes
    ----------
    level, luminance, colour:
        Bin centres (b,) in 0..1, shares (n, b) of the pixels in each bin, and the same for red, green and blue (n, 3, b).
    slope, gradient:
        Bin centres (g,) of the luminance's derivative along x, 1/px, and their densities (n, g).
    frequency, power:
        Cycles per px (f,), and the radially averaged power (n, f) of the luminance minus its mean.
    """

    level: np.ndarray
    luminance: np.ndarray
    colour: np.ndarray
    slope: np.ndarray
    gradient: np.ndarray
    frequency: np.ndarray
    power: np.ndarray


def profiles(windows: list[np.ndarray], bins: int = 32) -> Profiles:
    """Histograms of luminance and colour, the distribution of gradients and the power spectrum of each image."""
    if not windows:
        raise ValueError("windows: no image to take distributions of.")
    edges, slopes = np.linspace(0, 1, bins + 1), np.linspace(-0.3, 0.3, 62)
    rings = np.geomspace(1 / 48, 1 / 2, 15)
    rows = []
    for window in windows:
        rgb, grey = window / 255.0, _luminance(window)
        derivative = np.diff(grey, axis=1)
        frequency, power = _power(grey)
        rows.append(
            (
                np.histogram(grey, edges)[0] / grey.size,
                [np.histogram(rgb[..., c], edges)[0] / grey.size for c in range(3)],
                np.histogram(derivative, slopes)[0] / derivative.size / np.diff(slopes),
                [power[(frequency >= a) & (frequency < b)].mean() for a, b in itertools.pairwise(rings)],
            )
        )
    luminance, colour, gradient, spectrum = (np.array(values) for values in zip(*rows, strict=True))
    middle = (edges[1:] + edges[:-1]) / 2, (slopes[1:] + slopes[:-1]) / 2, np.sqrt(rings[1:] * rings[:-1])
    return Profiles(middle[0], luminance, colour, middle[1], gradient, middle[2], spectrum)
