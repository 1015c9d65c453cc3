"""Effects of a simple lens, of camera electronics and of a recorder: blur, colours, noise, sharpening, compression."""

from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Video:
    """Effects on the finished image; the defaults change nothing.  Lengths are in px of the image.

    Attributes:
        defocus_px, astigmatism: Radius of the disc into which each point is blurred, and its stretch along the rows.
        fringe_px: Shift of red and blue against green, to opposite sides.
        colours: (3, 3) matrix from input to output colours: casts, permutations, grey.
        contrast, black, gamma: Tone curve: black + (1 - black) * contrast * value ** gamma, clipped.
        sharpening, sharpening_px: Strength and width of unsharp masking.
        noise, noise_px, noise_grey: Standard deviation (share of full scale), correlation length, share common to colours.
        banding: Standard deviation of a brightness error that is constant in a row.
        field_shift_px: Shift along x between odd and even rows.
        resample, chroma: Factors by which the image, and its colours, are shrunk for storage.
        mosaic, quality: True = one colour per pixel, interpolated; quality of the JPEG compression, 100 = none.
    """

    defocus_px: float = 0.0
    astigmatism: float = 1.0
    fringe_px: float = 0.0
    colours: tuple[tuple[float, ...], ...] = _IDENTITY
    contrast: float = 1.0
    black: float = 0.0
    gamma: float = 1.0
    sharpening: float = 0.0
    sharpening_px: float = 1.0
    noise: float = 0.0
    noise_px: float = 0.0
    noise_grey: float = 0.5
    banding: float = 0.0
    field_shift_px: float = 0.0
    resample: float = 1.0
    mosaic: bool = False
    chroma: int = 1
    quality: float = 100

    def __call__(self, image: np.ndarray, rng: np.random.Generator | None) -> np.ndarray:
        """Apply the effects to an image (h, w, 3) uint8 RGB; without `rng` there is no noise and no banding."""
        height, width = image.shape[:2]
        if self.resample != 1.0:
            size = max(round(width / self.resample), 16), max(round(height / self.resample), 16)
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if self.resample > 1 else cv2.INTER_CUBIC)
        value = image.astype(np.float32) / 255
        if self.defocus_px / self.resample > 0.4:
            value = _disc_blur(value, self.defocus_px / self.resample, self.astigmatism)
        if self.fringe_px:
            for channel, sign in ((0, 0.8), (2, -0.8)):
                value[..., channel] = _shifted(value[..., channel], sign * self.fringe_px, 0.75 * sign * self.fringe_px)
        if self.colours != _IDENTITY:
            value = cv2.transform(value, np.float32(self.colours))
        if self.gamma != 1.0:
            value = cv2.pow(np.clip(value, 0, None), self.gamma)
        value = np.clip(np.float32(self.black) + np.float32((1 - self.black) * self.contrast) * value, 0, 1)
        if rng is not None and self.noise:
            noise = rng.standard_normal(value.shape, dtype=np.float32) * np.float32(1 - self.noise_grey)
            noise += rng.standard_normal((*value.shape[:2], 1), dtype=np.float32) * np.float32(self.noise_grey)
            if self.noise_px > 0.3:
                noise = cv2.GaussianBlur(noise, (0, 0), self.noise_px)
            value += noise * np.float32(self.noise / max(float(noise.std()), 1e-6))
        if rng is not None and self.banding:
            value += np.float32(self.banding) * rng.standard_normal((value.shape[0], 1, 1), dtype=np.float32)
        if self.mosaic:  # sampled through a colour filter of 2 x 2 pixels and interpolated
            raw = np.clip(value[..., 1], 0, 1).copy()
            raw[::2, ::2], raw[1::2, 1::2] = value[::2, ::2, 0], value[1::2, 1::2, 2]
            value = cv2.cvtColor(cv2.convertScaleAbs(raw, alpha=255), cv2.COLOR_BayerBG2RGB).astype(np.float32) / 255
        if self.sharpening:
            value += np.float32(self.sharpening) * (value - cv2.GaussianBlur(value, (0, 0), self.sharpening_px))
        image = cv2.convertScaleAbs(np.clip(value, 0, 1), alpha=255)
        if self.field_shift_px:
            for first, sign in ((0, -0.5), (1, 0.5)):
                image[first::2] = _shifted(image[first::2], sign * self.field_shift_px, 0.0)
        if self.chroma > 1:
            ycc = cv2.cvtColor(image, cv2.COLOR_RGB2YCrCb)
            size = max(image.shape[1] // self.chroma, 1), max(image.shape[0] // self.chroma, 1)
            coarse = cv2.resize(ycc[..., 1:], size, interpolation=cv2.INTER_AREA)
            ycc[..., 1:] = cv2.resize(coarse, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
            image = cv2.cvtColor(ycc, cv2.COLOR_YCrCb2RGB)
        if self.quality < 100:
            image = compressed(image, int(self.quality))
        return image if self.resample == 1.0 else cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)

    def shrunk(self, factor: float) -> Self:
        """The effects for an image scaled by `factor`: defocus, fringes and field shift are scaled, the rest stays."""
        return replace(self, **{name: factor * getattr(self, name) for name in ("defocus_px", "fringe_px", "field_shift_px")})


def compressed(image: np.ndarray, quality: int) -> np.ndarray:
    """Compress an image as JPEG and decode it."""
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)


def _shifted(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """Shift an image by (x, y) px."""
    return cv2.warpAffine(image, np.float32([[1, 0, x], [0, 1, y]]), image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)


def _disc_blur(value: np.ndarray, radius: float, stretch: float) -> np.ndarray:
    """Blur an image by a soft ellipse; a wide one is applied at a lower resolution."""
    step = 1 << int(np.clip(np.log2(radius / 3.0), 0, 4))
    height, width = value.shape[:2]
    small = cv2.resize(value, (-(-width // step), -(-height // step)), interpolation=cv2.INTER_AREA) if step > 1 else value
    r = radius / step
    half = int(np.ceil(r * max(stretch, 1 / stretch))) + 1
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    kernel = np.clip(r + 0.5 - np.sqrt((x / stretch) ** 2 + (y * stretch) ** 2), 0, 1).astype(np.float32)
    small = cv2.filter2D(small, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC) if step > 1 else small
