"""The networks: the Stacked Hourglass (Newell et al. 2016; paper Sec. III) and the offset network for closeups.

`StackedHourglass` has the paper's five configurations.  Each of its layers keeps the half-pixel rule of
`lib.geometry`: the stem's even kernel is centred on its cell, pooling and nearest-neighbour upsampling are aligned with
cell borders.  So the centre of heatmap cell c lies at pixel stride * c + (stride - 1) / 2 of the input before any training.
The offset network is not in the paper: it measures one landmark that an hourglass has found.
"""

from __future__ import annotations

import copy
from collections.abc import Sized
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval

from lib.correspondences import LANDMARKS
from lib.geometry import check

STEM_STRIDE = 4


@dataclass(frozen=True)
class HourglassConfig:
    """Configuration of a `StackedHourglass`.

    Attributes:
        features: Number of channels, even.  The paper does not state it; notebook 02 concludes that it is below 256.
        stacks: Number of hourglasses in a row, each supervised.
        depth: Number of halvings inside an hourglass; with 4, inputs are padded to a multiple of 4 * 2**4 = 64.
        growth: Factor on the number of channels at each halving; 1 in the paper.
        decoder, skips, residual: The parts that the ablation adds one by one.  Without a decoder the stride is 4 * 2**depth.

        >>> HourglassConfig().stride, HourglassConfig(stacks=1, decoder=False, skips=False).stride
        (4, 64)
    """

    features: int = 64
    stacks: int = 2
    depth: int = 4
    growth: float = 1.0
    decoder: bool = True
    skips: bool = True
    residual: bool = True

    def __post_init__(self) -> None:
        check(self, "features", lambda v: v >= 2 and v % 2 == 0, "must be an even number of at least 2")
        check(self, "stacks depth", lambda v: v >= 1, "must be at least 1")
        check(self, "growth", lambda v: v == 1 or (v > 1 and self.decoder), "must be 1, or more with a decoder")
        if self.skips and not self.decoder:
            raise ValueError("skips: skip connections end in the decoder; set decoder=True or skips=False.")
        if self.stacks > 1 and not self.decoder:
            raise ValueError("stacks: hourglasses without a decoder cannot be stacked; set stacks=1 or decoder=True.")

    @property
    def stride(self) -> int:
        """Input pixels per heatmap cell."""
        return STEM_STRIDE if self.decoder else self.multiple

    @property
    def multiple(self) -> int:
        """Height and width are padded to a multiple of this."""
        return STEM_STRIDE * 2**self.depth


def _conv(inputs: int, outputs: int, kernel: int, *, stride: int = 1, relu: bool = True) -> nn.Sequential:
    layers = [nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False), nn.BatchNorm2d(outputs)]
    return nn.Sequential(*layers, nn.ReLU(inplace=True)) if relu else nn.Sequential(*layers)


class Network(nn.Module):
    """Base class of the networks: a configuration, and copies for storage and for inference."""

    config: HourglassConfig | OffsetConfig

    def halved(self) -> Self:
        """A copy with all weights rounded to half precision, so that its file has half the size."""
        return copy.deepcopy(self).half().float()

    def fused(self) -> Self:
        """A copy for inference: batch normalisation folded into the convolutions, channels last (same outputs)."""
        network = copy.deepcopy(self).eval()
        for module in [part for part in network.modules() if isinstance(part, nn.Sequential)]:
            for i in range(len(module) - 1):
                if isinstance(conv := module[i], nn.Conv2d) and isinstance(norm := module[i + 1], nn.BatchNorm2d):
                    module[i], module[i + 1] = fuse_conv_bn_eval(conv, norm), nn.Identity()
        return network.to(memory_format=torch.channels_last)


class _Block(nn.Module):
    """A body and its skip connection, if any."""

    def __init__(self, body: nn.Module, skip: nn.Module | None = None):
        super().__init__()
        self.body, self.skip = body, skip

    def forward(self, x: Tensor) -> Tensor:
        return self.body(x) if self.skip is None else F.relu(self.body(x) + self.skip(x))


def _box(inputs: int, outputs: int, residual: bool) -> _Block:
    """A box of the paper's figure: a bottleneck residual module (He et al. 2016), or a plain 3 x 3 convolution."""
    if not residual:
        return _Block(_conv(inputs, outputs, 3))
    middle = max(outputs // 2, 1)
    body = nn.Sequential(_conv(inputs, middle, 1), _conv(middle, middle, 3), _conv(middle, outputs, 1, relu=False))
    return _Block(body, nn.Identity() if inputs == outputs else _conv(inputs, outputs, 1, relu=False))


def _residual(inputs: int, outputs: int) -> _Block:
    """Two 3 x 3 convolutions with a skip connection (He et al. 2016), which halve the resolution if they add channels."""
    halve = inputs != outputs
    body = nn.Sequential(_conv(inputs, outputs, 3, stride=2 if halve else 1), _conv(outputs, outputs, 3, relu=False))
    return _Block(body, nn.Sequential(nn.AvgPool2d(2), _conv(inputs, outputs, 1, relu=False)) if halve else nn.Identity())


class _Hourglass(nn.Module):
    """Halve the resolution, process (recursively), double it, and add the skip connection."""

    def __init__(self, config: HourglassConfig, depth: int, f: int):
        super().__init__()
        residual, below = config.residual, 2 * round(f * config.growth / 2)
        self.skip = _box(f, f, residual) if config.skips else None
        self.down = _box(f, below, residual)
        self.inner = _Hourglass(config, depth - 1, below) if depth > 1 else _box(below, below, residual)
        self.up = _box(below, f, residual) if config.decoder else None

    def forward(self, x: Tensor) -> Tensor:
        y = self.inner(self.down(F.max_pool2d(x, 2)))
        if self.up is None:
            return y
        y = F.interpolate(self.up(y), scale_factor=2.0, mode="nearest")
        return y if self.skip is None else y + self.skip(x)


class StackedHourglass(Network):
    """Computes landmark heatmaps from images.

    ``forward(images)`` takes float images (n, 3, h, w) in [0, 1], RGB, of any size, pads them with zeros at the right
    and bottom, and returns one (n, 3, ceil(h / stride), ceil(w / stride)) heatmap tensor per stack, the final one last.
    It raises ValueError if the images do not have three channels.

    >>> heatmaps = StackedHourglass(HourglassConfig(features=8))(torch.zeros(1, 3, 60, 100))
    >>> len(heatmaps), heatmaps[-1].shape
    (2, torch.Size([1, 3, 15, 25]))
    """

    def __init__(self, config: HourglassConfig | None = None):
        super().__init__()
        self.config = config = config or HourglassConfig()
        self.stride = config.stride
        f, half, residual = config.features, config.features // 2, config.residual
        first = nn.Conv2d(3, half, 6, stride=2, padding=2, bias=False)  # even kernel: centred between pixels 2i and 2i + 1
        self.stem = nn.Sequential(
            first, nn.BatchNorm2d(half), nn.ReLU(inplace=True), _box(half, half, residual),
            nn.MaxPool2d(2), _box(half, f, residual), _box(f, f, residual),
        )  # fmt: skip
        stacks = range(config.stacks)
        self.hourglasses = nn.ModuleList([_Hourglass(config, config.depth, f) for _ in stacks])
        self.features = nn.ModuleList([nn.Sequential(_box(f, f, residual), _conv(f, f, 1)) for _ in stacks])
        self.heads = nn.ModuleList([nn.Conv2d(f, len(LANDMARKS), 1) for _ in stacks])
        between = stacks[:-1]
        self.merge_features = nn.ModuleList([nn.Conv2d(f, f, 1) for _ in between])
        self.merge_heatmaps = nn.ModuleList([nn.Conv2d(len(LANDMARKS), f, 1) for _ in between])
        for head in self.heads:  # almost all of a target is 0, so the outputs start near 0
            nn.init.normal_(head.weight, std=1e-3)
            nn.init.zeros_(head.bias)

    def forward(self, images: Tensor) -> list[Tensor]:
        if images.ndim != 4 or images.shape[1] != 3:
            cure = "Repeat a grey channel three times; drop an alpha channel"
            raise ValueError(f"images: the network takes (n, 3, h, w) RGB, got {tuple(images.shape)}. {cure}.")
        h, w = images.shape[-2:]
        multiple, stride = self.config.multiple, self.stride
        padded = F.pad(images, (0, -w % multiple, 0, -h % multiple))
        x = self.stem((padded - 0.5) * 4.0)  # about zero mean and unit variance
        outputs = []
        for i, hourglass in enumerate(self.hourglasses):
            y = self.features[i](hourglass(x))
            heatmaps = self.heads[i](y)
            outputs.append(heatmaps[..., : -(-h // stride), : -(-w // stride)])
            if i + 1 < len(self.hourglasses):
                x = x + self.merge_features[i](y) + self.merge_heatmaps[i](heatmaps)
        return outputs


@dataclass(frozen=True)
class OffsetConfig:
    """Configuration of an `OffsetNetwork`.

    Attributes:
        features: Channels at half the closeup's resolution; there are more at lower resolutions.
        size_px: Side of the closeups, a multiple of 16.
    """

    features: int = 32
    size_px: int = 64

    def __post_init__(self) -> None:
        check(self, "features", lambda v: v >= 1, "must be positive")
        check(self, "size_px", lambda v: v >= 16 and v % 16 == 0, "must be a multiple of 16")


class OffsetNetwork(Network):
    """Predicts from a closeup the offset of the landmark from the centre, and the scale of the offset's error.

    ``forward(images)`` takes float images (n, 3, s, s) in [0, 1], RGB, and returns a list, as the hourglass does, with one
    tensor (n, 4): the offset along x and y in pixels, and the logarithms of the scales of their errors in pixels, limited to
    -6 to 5.  It raises ValueError if the images have another size.

    >>> OffsetNetwork(OffsetConfig(features=8)).eval()(torch.zeros(2, 3, 64, 64))[0].shape
    torch.Size([2, 4])
    """

    def __init__(self, config: OffsetConfig | None = None):
        super().__init__()
        self.config = config = config or OffsetConfig()
        f = config.features
        self.body = nn.Sequential(
            _conv(3, f, 5, stride=2), _residual(f, f), _residual(f, 2 * f), _residual(2 * f, 2 * f),
            _residual(2 * f, 3 * f), _residual(3 * f, 3 * f), _residual(3 * f, 4 * f),
        )  # fmt: skip
        # Fully connected, because a mean over the closeup would lose the positions of what it shows.
        side = config.size_px // 16
        self.head = nn.Sequential(nn.Flatten(), nn.Linear(4 * f * side**2, 128), nn.ReLU(inplace=True), nn.Linear(128, 4))
        nn.init.zeros_(self.head[-1].weight)  # the first prediction is the centre, with an error scale of 1 px
        nn.init.zeros_(self.head[-1].bias)

    def forward(self, images: Tensor) -> list[Tensor]:
        size = self.config.size_px
        if images.ndim != 4 or tuple(images.shape[1:]) != (3, size, size):
            raise ValueError(f"images: the network takes (n, 3, {size}, {size}) RGB, got {tuple(images.shape)}.")
        y = self.head(self.body((images - 0.5) * 4.0))
        return [torch.cat([y[:, :2] * (size / 8), y[:, 2:].clamp(-6, 5)], dim=1)]


def network_of(config: HourglassConfig | OffsetConfig) -> Network:
    """Make a new network of this configuration."""
    return OffsetNetwork(config) if isinstance(config, OffsetConfig) else StackedHourglass(config)


def as_uint8(images: ArrayLike) -> np.ndarray:
    """Convert images (n, h, w, 3), or grey (n, h, w, 1), uint8 or float in [0, 1], to (n, h, w, 3) uint8.

    Raises ValueError for another shape, type or range.

    >>> as_uint8(np.full((1, 2, 4, 3), 0.5)).max()
    np.uint8(128)
    """
    array = np.asarray(images)
    if array.ndim == 4 and array.shape[-1] == 1:
        array = np.repeat(array, 3, axis=-1)
    if array.ndim != 4 or array.shape[-1] != 3:
        cure = "Add a first axis for one image; drop an alpha channel"
        raise ValueError(f"images: expected (n, h, w, 3) RGB or (n, h, w, 1) grey, got {array.shape}. {cure}.")
    if not array.size:
        raise ValueError(f"images: empty, {array.shape}; give at least one image.")
    if array.dtype == np.uint8:
        return array
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"images: expected uint8 or float, got {array.dtype}; divide by the largest value.")
    low, high = float(array.min()), float(array.max())
    if np.isnan(low):
        raise ValueError("images: float images must lie in [0, 1], but some pixels are NaN; replace them, such as by 0.")
    if not (low >= 0.0 and high <= 1.0):
        raise ValueError(f"images: float images must lie in [0, 1], got {low:g} to {high:g}; divide by 255?")
    return np.round(array * 255).astype(np.uint8)


def images_for(values: Sized, name: str, images: ArrayLike) -> np.ndarray:
    """Convert images by `as_uint8`; a ValueError names the argument `name` if it does not hold a value for each image."""
    images = as_uint8(images)
    if len(values) != len(images):
        raise ValueError(f"{name}: holds {len(values)} images, but images {len(images)}; give one for each.")
    return images


def as_tensor(images: ArrayLike) -> Tensor:
    """Convert images, as `as_uint8` takes them, to the networks' input: (n, 3, h, w) float in [0, 1], channels last."""
    return torch.from_numpy(np.ascontiguousarray(as_uint8(images))).permute(0, 3, 1, 2).float().div_(255.0)
