"""Augmentation with kornia: image and landmarks move together; landmarks that leave the frame become absent.

Kornia's elastic, thin-plate and fisheye transforms are left out: they move the image and not the points.  Its motion blur
shifts content unless its direction is 0.  Random numbers come from a batch's own generator: a resumed training repeats them.
"""

from dataclasses import dataclass
from functools import partial

import kornia.augmentation as K
import numpy as np
import torch
from torch import Tensor

from lib.geometry import check

OCCLUDED, VISIBLE = 1, 2
#: Height of an occluded landmark's target: the network still learns its position, and that it is not visible.
OCCLUDED_PEAK = 0.5


@dataclass(frozen=True)
class Batch:
    """Images (n, 3, h, w) float in [0, 1], landmarks u (n, 3, 2) px, visibility (n, 3).

    Visibility as in COCO: 2 visible, 1 occluded, 0 not in the frame.  A NaN landmark is unlabelled.
    """

    images: Tensor
    u: Tensor
    visibility: Tensor

    @property
    def weight(self) -> Tensor:
        """(n, 3): 0 for unlabelled landmarks, which have no loss; 1 for others, also absent ones (their target is empty)."""
        return (~torch.isnan(self.u).any(-1) | (self.visibility == 0)).to(self.images.dtype)

    @property
    def peak(self) -> Tensor:
        """(n, 3): height of the target, 1 if visible, `OCCLUDED_PEAK` if occluded, 0 if absent."""
        return self.images.new_tensor([0.0, OCCLUDED_PEAK, 1.0])[self.visibility.long()]


@dataclass(frozen=True)
class Augmentation:
    """Ranges of the random transforms; 0 switches one off.  The defaults are the paper's.

    Attributes:
        rotation_deg: Largest rotation about the image's centre, in either direction.
        zoom: Range of the scale factor, which is drawn uniformly.
        photometric, photometric_share: Strength (0 to 1) of the changes of light and optics; share of a batch with changes.
    """

    rotation_deg: float = 30.0
    zoom: tuple[float, float] = (0.75, 1.25)
    photometric: float = 0.0
    photometric_share: float = 1.0

    def __post_init__(self) -> None:
        check(self, "zoom", lambda v: 0 < v[0] <= v[1], "expected 0 < smallest <= largest")
        check(self, "photometric photometric_share", lambda v: 0 <= v <= 1, "must lie between 0 and 1")

    def __call__(self, batch: Batch, rng: np.random.Generator) -> Batch:
        """Return a transformed copy of the batch."""
        changed = round(self.photometric_share * len(batch.u)) if self.photometric else 0
        with torch.random.fork_rng(devices=[]):  # kornia draws from torch's global generator
            torch.manual_seed(int(rng.integers(2**63)))
            images, u, visibility = batch.images, batch.u.clone(), batch.visibility.clone()
            if self.rotation_deg or self.zoom != (1.0, 1.0):
                affine = K.RandomAffine(self.rotation_deg, scale=self.zoom, padding_mode="border", p=1.0)
                both = K.AugmentationSequential(affine, data_keys=["input", "keypoints"])
                images, u = both(images, u.to(images.dtype))  # NaN points stay NaN
            if changed:
                images = torch.cat([self.light()(images[:changed]).clamp(0, 1), images[changed:]])
                self._occlude(images[:changed], u[:changed], visibility[:changed], rng)
        return Batch(images, u.to(batch.u.dtype), leave_frame(u, visibility, images.shape[-2:]))

    def light(self) -> K.ImageSequential:
        """The random changes of light, focus and sensor."""
        s = self.photometric
        return K.ImageSequential(
            K.ColorJiggle(0.25 * s, 0.3 * s, 0.4 * s, 0.06 * s, p=0.8),
            K.RandomGamma((1 - 0.35 * s, 1 + 0.45 * s), p=0.5),
            K.RandomLinearIllumination((0.01, 0.3 * s), p=0.3),
            K.RandomGaussianBlur((7, 7), (0.3, 0.3 + 1.7 * s), p=0.4),
            K.RandomMotionBlur(5, 180.0, 0.0, p=0.15),  # direction 0: the content stays where it is
            K.RandomGaussianNoise(0.0, 0.03 * s, p=0.5),
        )

    def _occlude(self, images: Tensor, u: Tensor, visibility: Tensor, rng: np.random.Generator) -> None:
        """Draw glints (bright discs) and occluders (smooth ellipses), in place; mark what an occluder covers as occluded."""
        h, w = images.shape[-2:]
        to = partial(torch.as_tensor, device=images.device)
        pixels = to(np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1, dtype=float))
        for i in range(len(images)):
            if rng.random() < 0.3 * self.photometric:
                centre, radius = rng.uniform((0, 0), (w, h)), rng.uniform(1.0, 0.03 * h + 2)
                glow = torch.exp(-0.5 * (pixels - to(centre)).square().sum(-1) / radius**2)
                images[i] = (images[i] + rng.uniform(0.4, 1.0) * glow).clamp(0, 1)
            if rng.random() < 0.15 * self.photometric:
                centre, axes, angle = rng.uniform((0, 0), (w, h)), rng.uniform(0.03, 0.12, 2) * h, rng.uniform(0, np.pi)
                turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) / axes
                from_centre = ((at - to(centre)) @ to(turn) for at in (pixels, u[i].double()))
                cover, covered = (torch.sigmoid(6 * (1 - part.square().sum(-1))) for part in from_centre)
                colour = to(rng.uniform(0.02, 0.8) * rng.uniform(0.5, 1.0, 3))
                images[i] = images[i] * (1 - cover) + colour[:, None, None] * cover
                visibility[i] = torch.where((covered > 0.3) & (visibility[i] == VISIBLE), OCCLUDED, visibility[i])


def leave_frame(u: Tensor, visibility: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Returns visibility with 0 for every labelled landmark outside the pixels of an image of size (h, w)."""
    h, w = image_size
    outside = (u < -0.5).any(-1) | (u[..., 0] >= w - 0.5) | (u[..., 1] >= h - 0.5)  # NaN is not outside
    return torch.where(outside, 0, visibility)


#: "none" is for sources that augment what they draw, "closeups" for closeups, which are already rotated and mirrored.
AUGMENTATIONS = {
    "none": Augmentation(0.0, (1.0, 1.0)),
    "paper": Augmentation(),
    "closeups": Augmentation(0.0, (1.0, 1.0), photometric=1.0, photometric_share=0.25),
}
