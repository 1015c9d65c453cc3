"""Training a Stacked Hourglass: l2 loss with intermediate supervision, presets, exact resume.  Offset networks train alike.

All randomness of step t comes from a generator seeded with (seed, t), so a run that was interrupted and resumed equals one
that was not, bit for bit on the CPU: the step's number is the whole state of the generators.
"""

from __future__ import annotations

import argparse
import copy
import csv
import hashlib
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from tqdm.auto import tqdm

from lib import paths
from lib.landmarks.checkpoints import load_network, read_checkpoint, write_checkpoint
from lib.landmarks.error_model import closeup_peaks
from lib.landmarks.heatmaps import SIGMA_PX, decode, render, sigma_cells
from lib.landmarks.images import as_tensor
from lib.landmarks.metrics import errors_px, pck, tool_length_px
from lib.landmarks.network import (
    HourglassConfig,
    OffsetConfig,
    OffsetNetwork,
    StackedHourglass,
    config_of,
    network_of,
)
from lib.provenance import commit_id, machine
from lib.training.augmentation import AUGMENTATIONS, Augmentation, Batch, leave_frame

__all__ = [
    "PRESETS",
    "Samples",
    "Training",
    "TrainingConfig",
    "heatmap_loss",
    "load_training",
    "main",
    "offset_loss",
    "position_loss",
    "train",
    "validate",
]

FORMAT = "microstereo.training"


class Source(Protocol):
    """Labelled images that training draws from; all of one size."""

    def __len__(self) -> int: ...

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image (h, w, 3) uint8, landmarks (3, 2) px, visibility (3,)."""
        ...

    @property
    def fingerprint(self) -> str:
        """Tells this data from other data."""
        ...


@dataclass(frozen=True)
class Samples:
    """Labelled images in memory.

    Attributes
    ----------
    images:
        (n, h, w, 3) uint8 RGB.
    u:
        (n, 3, 2) px; NaN = unlabelled.
    visibility:
        (n, 3): 2 visible, 1 occluded, 0 not in the frame.
    """

    images: np.ndarray
    u: np.ndarray
    visibility: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.images)
        if n == 0:
            raise ValueError("images: an empty data set; give at least one labelled image.")
        if self.images.ndim != 4 or self.images.shape[-1] != 3 or self.images.dtype != np.uint8:
            raise ValueError(f"images: expected (n, h, w, 3) uint8, got {self.images.shape} {self.images.dtype}.")
        if self.u.shape != (n, 3, 2) or self.visibility.shape != (n, 3):
            raise ValueError(
                f"u and visibility: expected ({n}, 3, 2) and ({n}, 3), got {self.u.shape} and {self.visibility.shape}."
            )
        if not (np.isfinite(self.u).all(2) & (self.visibility == 2)).any():
            raise ValueError("u: all landmarks of all images are missing; there is nothing to learn.")

    @classmethod
    def drawn(cls, source: Source, seed: int = 0) -> Samples:
        """One drawn image of each that `source` has: validation samples."""
        rng = np.random.default_rng(seed)
        images, u, visibility = zip(*(source.draw(i, rng) for i in range(len(source))), strict=True)
        return cls(np.stack(images), np.stack(u), np.stack(visibility))

    def __len__(self) -> int:
        return len(self.images)

    def draw(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.images[index], self.u[index], self.visibility[index]

    @property
    def fingerprint(self) -> str:
        digest = hashlib.sha256(np.ascontiguousarray(self.images[:, ::7, ::7]).tobytes())
        digest.update(np.nan_to_num(self.u, nan=-1.0).tobytes())
        digest.update(np.asarray(self.visibility, dtype=np.int64).tobytes())
        return digest.hexdigest()[:16]


@dataclass(frozen=True)
class TrainingConfig:
    """Everything that decides a training, but the data.

    Attributes
    ----------
    optimiser, learning_rate, schedule:
        ``"rmsprop"`` (alpha 0.99, no momentum, as printed) or ``"adamw"``; ``"constant"`` or ``"cosine"`` after a warm-up.
    ema:
        Decay of the weights' moving average that is validated and returned; 0 = the weights themselves.
    clip:
        Largest norm of the gradient; 0 = unlimited.
    position_weight_per_px:
        Weight of `position_loss` beside the heatmaps' l2 loss, which is all that the paper has (0).
    precision:
        ``"fp32"``, or ``"bf16"`` mixed precision; the loss is always float32.
    patience:
        Validations without a better one before training stops; 0 = never.
    """

    network: HourglassConfig | OffsetConfig = field(default_factory=HourglassConfig)
    augmentation: Augmentation = AUGMENTATIONS["paper"]
    steps: int = 1000
    batch_size: int = 4
    optimiser: str = "rmsprop"
    learning_rate: float = 5e-5
    schedule: str = "constant"
    ema: float = 0.0
    clip: float = 0.0
    precision: str = "fp32"
    sigma_px: float = SIGMA_PX
    position_weight_per_px: float = 0.0
    validate_every: int = 100
    patience: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, choices in (
            ("optimiser", ("rmsprop", "adamw")),
            ("schedule", ("constant", "cosine")),
            ("precision", ("fp32", "bf16")),
        ):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}.")
        if min(self.steps, self.batch_size, self.validate_every) < 1:
            raise ValueError("steps, batch_size, validate_every: must be at least 1.")

    def rate(self, step: int) -> float:
        """Learning rate of a step."""
        if self.schedule == "constant":
            return self.learning_rate
        warm = min(1.0, (step + 1) / max(1, min(100, self.steps // 10)))
        return self.learning_rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / self.steps)))


#: `paper`: as printed. `best`: what trains the shipped networks.
PRESETS = {
    "paper": TrainingConfig(),
    "best": TrainingConfig(
        augmentation=AUGMENTATIONS["best"],
        batch_size=12,
        optimiser="adamw",
        learning_rate=2e-3,
        schedule="cosine",
        ema=0.998,
        clip=1.0,
        precision="bf16",
    ),
}


def heatmap_loss(outputs: Sequence[Tensor], batch: Batch, stride: int, sigma_px: float = SIGMA_PX) -> Tensor:
    """Squared distance of every stack's heatmaps from the Gaussians, so scaled that empty heatmaps cost 1.

    Sum over cells divided by pi sigma^2 (what a Gaussian of peak 1 has), mean over the landmarks that count, mean over
    stacks (intermediate supervision).
    """
    target = render(batch.u.float(), tuple(batch.images.shape[-2:]), stride, sigma_px) * batch.peak[..., None, None]
    weight = batch.weight
    scale = math.pi * sigma_cells(stride, sigma_px) ** 2 * weight.sum().clamp_min(1)
    losses = [((output.float() - target).square().sum((-2, -1)) * weight).sum() / scale for output in outputs]
    return torch.stack(losses).mean()


def position_loss(outputs: Sequence[Tensor], batch: Batch, stride: int, sigma_px: float = SIGMA_PX) -> Tensor:
    """Mean distance in px (smoothed within 0.2 px) of every stack's peaks from the visible landmarks.

    The l2 loss of heatmaps hardly feels the last pixel: a displacement d costs (d / sigma)^2 / 2 of an empty heatmap.
    A peak's place is twice the centroid of its product with the target's Gaussian, relative to the landmark: exact for
    a Gaussian of the same width (the product's centre lies halfway), smooth, and blind to what lies far away.  Landmarks
    within 2 sigma of the border, where the sums are cut, and those with less than a quarter of a peak do not count.
    """
    size = tuple(batch.images.shape[-2:])
    u = batch.u.float()
    inside = ((u > 2 * sigma_px) & (u < u.new_tensor(size[::-1]) - 1 - 2 * sigma_px)).all(-1)  # NaN is not inside
    weight = (inside & (batch.visibility == 2)).float()
    target = render(u, size, stride, sigma_px)
    rows, columns = (
        stride * torch.arange(n, dtype=u.dtype, device=u.device) + (stride - 1) / 2 for n in target.shape[-2:]
    )
    least = 0.25 * math.pi * sigma_cells(stride, sigma_px) ** 2
    losses = []
    for output in outputs:
        product = output.float() * target
        sums = [product.sum(-2) @ columns, product.sum(-1) @ rows]
        total = product.sum((-2, -1))
        moved = torch.stack(sums, -1) - total[..., None] * torch.nan_to_num(u)
        there = weight * (total > least)
        distance = ((2 * moved / total.clamp_min(least)[..., None]).square().sum(-1) + 0.04).sqrt() - 0.2
        losses.append((distance * there).sum() / weight.sum().clamp_min(1))
    return torch.stack(losses).mean()


def offset_loss(outputs: Sequence[Tensor], batch: Batch) -> Tensor:
    """Negative log likelihood of an `OffsetNetwork`'s errors under Laplace distributions of the scales that it states.

    Each closeup has one visible landmark, or none: then it does not count.  The absolute error, smoothed within 0.1 px,
    makes blunders weigh little; divided by the scale, a sharp image weighs more than a blurred one.
    """
    (found,) = outputs
    centre = (batch.images.shape[-1] - 1) / 2
    own = batch.visibility == 2
    there = own.any(1).float()
    true = torch.where(own[..., None], batch.u.float(), 0.0).sum(1) - centre
    distance = ((found[:, :2].float() - true).square() + 0.01).sqrt()
    log_scale = found[:, 2:].float()
    return ((log_scale + distance * (-log_scale).exp()).sum(1) * there).sum() / there.sum().clamp_min(1)


def _loss(network: nn.Module, outputs: Sequence[Tensor], batch: Batch, config: TrainingConfig) -> Tensor:
    if isinstance(network, OffsetNetwork):
        return offset_loss(outputs, batch)
    loss = heatmap_loss(outputs, batch, network.stride, config.sigma_px)
    if config.position_weight_per_px:
        where = position_loss(outputs, batch, network.stride, config.sigma_px)
        loss = loss + config.position_weight_per_px * where
    return loss


@dataclass(frozen=True)
class Training:
    """A finished (or stopped) training: the network to use, one log row per validation, and where it came from."""

    network: StackedHourglass | OffsetNetwork
    log: list[dict[str, float]]
    provenance: dict[str, object]


def _processes() -> tuple[int, int]:
    """Rank of this process, and how many train together: torchrun starts them and tells each by its environment."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    return (dist.get_rank(), world) if world > 1 else (0, 1)


def _average(tensors: Sequence[Tensor], world: int) -> None:
    """Replace tensors by their means over the processes."""
    together = torch.cat([t.flatten() for t in tensors])
    dist.all_reduce(together)
    together /= world
    for tensor, mean in zip(tensors, together.split([t.numel() for t in tensors]), strict=True):
        tensor.copy_(mean.view_as(tensor))


def _batch(source: Source, config: TrainingConfig, step: int, rank: int = 0) -> Batch:
    rng = np.random.default_rng([config.seed, step, rank] if rank else [config.seed, step])
    indices = rng.choice(len(source), config.batch_size, replace=len(source) < config.batch_size)
    drawn = [source.draw(int(i), rng) for i in indices]
    images = as_tensor(np.stack([image for image, _, _ in drawn])).contiguous()
    u = torch.from_numpy(np.stack([u for _, u, _ in drawn])).float()
    visibility = torch.from_numpy(np.stack([v for _, _, v in drawn]).astype(np.int64))
    visibility = leave_frame(u, visibility, tuple(images.shape[-2:]))
    return config.augmentation(Batch(images, u, visibility), rng)


@torch.no_grad()
def validate(
    network: StackedHourglass | OffsetNetwork, samples: Samples, config: TrainingConfig, *, batch: int = 16
) -> dict[str, float]:
    """Loss, PCK and median error on held-out images, and two signs of a collapsed network.

    `peak` (the mean height of visible landmarks' heatmaps; 1 is right) near 0, or `spread` (the deviation of
    predictions over that of the labels) near 0, say that the network predicts nothing, or always the same.  An
    `OffsetNetwork` has no peaks, and no height of them.
    """
    network.eval()
    device = next(network.parameters()).device
    losses, found, values = [], [], []
    measured = replace(config, position_weight_per_px=0.0)
    for start in range(0, len(samples), batch):
        part = slice(start, start + batch)
        images = as_tensor(samples.images[part])
        u, visibility = torch.from_numpy(samples.u[part]).float(), torch.from_numpy(samples.visibility[part])
        visibility = leave_frame(u, visibility, tuple(images.shape[-2:]))
        outputs = [output.cpu() for output in network(images.to(device))]
        losses.append(_loss(network, outputs, Batch(images, u, visibility), measured).item())
        if isinstance(network, OffsetNetwork):
            peaks = closeup_peaks(outputs[-1], images.shape[-1])
        else:
            peaks = decode(outputs[-1], network.stride, sigma_px=config.sigma_px)
        found.append(peaks.u.expand(-1, 3, -1).numpy())
        values.append(torch.where(visibility == 2, peaks.value, torch.nan).numpy())
    u = np.concatenate(found).astype(float)
    h, w = samples.images.shape[1:3]
    inside = (samples.u > -0.5).all(2) & (samples.u < (w - 0.5, h - 0.5)).all(2) & (samples.visibility == 2)
    labels = np.where(inside[..., None], samples.u, np.nan)
    error = errors_px(u, labels)
    length = tool_length_px(samples.u)
    spread = np.nanmean(np.nanstd(np.where(inside[..., None], u, np.nan), 0)) / np.nanmean(np.nanstd(labels, 0))
    result = {
        "validation_loss": float(np.mean(losses)),
        "pck_0.05": float(pck(u, labels, 0.05, length_px=length)),
        "pck_0.10": float(pck(u, labels, 0.10, length_px=length)),
        "median_px": float(np.nanmedian(error)),
        "p95_px": float(np.nanpercentile(error, 95)),
        "peak": float(np.nanmean(np.concatenate(values))),
        "spread": float(spread),
    }
    if isinstance(network, OffsetNetwork):
        del result["peak"]
    return result


class _Run:
    """Weights, optimiser and log of a training under way, and their file."""

    def __init__(self, config: TrainingConfig, initial: StackedHourglass | OffsetNetwork | None):
        self.config = config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = copy.deepcopy(initial) if initial is not None else network_of(config.network)
        self.rank, self.world = _processes()
        self.device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")) if self.world > 1 else 0)
        if not torch.cuda.is_available():
            self.device = torch.device("cpu")
        self.network.to(self.device, memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.network) if config.ema else None
        parameters = self.network.parameters()
        if config.optimiser == "rmsprop":
            self.optimiser: torch.optim.Optimizer = torch.optim.RMSprop(parameters, config.learning_rate, alpha=0.99)
        else:
            self.optimiser = torch.optim.AdamW(parameters, config.learning_rate, weight_decay=1e-4)
        self.step, self.seconds, self.log = 0, 0.0, []
        self.loss_sum, self.since = 0.0, 0  # since the last validation
        self.best = math.inf

    @property
    def usable(self) -> StackedHourglass | OffsetNetwork:
        return self.average if self.average is not None else self.network

    def advance(self, batch: Batch) -> float:
        """One step; returns its loss."""
        self.network.train()
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.rate(self.step)
        batch = batch.to(self.device)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.precision == "bf16"):
            outputs = self.network(batch.images.contiguous(memory_format=torch.channels_last))
        loss = _loss(self.network, outputs, batch, self.config)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        if self.world > 1:
            with torch.no_grad():
                _average([p.grad for p in self.network.parameters() if p.grad is not None], self.world)
                _average([b for b in self.network.buffers() if b.is_floating_point()], self.world)
        if self.config.clip:
            nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        self.optimiser.step()
        if self.average is not None:
            # A young average must not remember the random start.
            decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
            with torch.no_grad():
                for mean, value in zip(
                    self.average.state_dict().values(), self.network.state_dict().values(), strict=True
                ):
                    mean.lerp_(value, 1 - decay) if mean.is_floating_point() else mean.copy_(value)
        self.step += 1
        return loss.item()

    def agreed(self, stop: bool) -> bool:
        """What the first process says: clocks differ, and all must stop together."""
        if self.world == 1:
            return stop
        flag = torch.tensor(float(stop), device=self.device)
        dist.broadcast(flag, 0)
        return bool(flag)

    def save(self, path: Path, provenance: dict[str, object]) -> None:
        tensors = {f"network.{k}": v for k, v in self.network.state_dict().items()}
        if self.average is not None:
            tensors |= {f"average.{k}": v for k, v in self.average.state_dict().items()}
        for i, values in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{i}.{k}": torch.as_tensor(v) for k, v in values.items()}
        metadata = {
            "format": FORMAT,
            "config": asdict(self.config),
            "step": self.step,
            "seconds": self.seconds,
            "best": self.best if math.isfinite(self.best) else None,
            "log": self.log,
            "loss_sum": self.loss_sum,
            "since": self.since,
            "provenance": provenance,
        }
        write_checkpoint(path, tensors, metadata)

    def restore(self, path: Path, provenance: dict[str, object]) -> None:
        """Go on from a checkpoint; `provenance` is completed by where that came from."""
        tensors, metadata = read_checkpoint(path, FORMAT)
        # Only what may change between two sittings of one run.
        free = {"validate_every", "patience"}
        own, other = asdict(self.config), asdict(_config(path, metadata["config"]))
        changed = [name for name, value in own.items() if name not in free and value != other[name]]
        if changed:
            raise ValueError(f"{path}: belongs to a training with another {', '.join(changed)}; use another folder.")
        kept = metadata["provenance"]
        if kept["data"] != provenance["data"]:
            raise ValueError(f"{path}: was trained on other data (fingerprint differs); use another folder.")
        if provenance.get("initial") not in (None, kept.get("initial")):
            raise ValueError(f"{path}: was begun from other weights; give those as `initial`, or use another folder.")
        provenance |= {key: kept[key] for key in ("initial", "before", "metrics") if key in kept}
        processes = kept.get("processes", 1)
        if processes != self.world:  # the batches, and so the result, would be others
            raise ValueError(
                f"{path}: was begun by {processes} process(es), now {self.world}; start as many, or use another folder."
            )
        self.network.load_state_dict(_part(tensors, "network."))
        if self.average is not None:
            self.average.load_state_dict(_part(tensors, "average."))
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in _part(tensors, "optimiser.").items():
            i, _, key = name.partition(".")
            state.setdefault(int(i), {})[key] = value
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": state})
        self.step, self.seconds, self.log = metadata["step"], metadata["seconds"], metadata["log"]
        self.loss_sum, self.since = metadata.get("loss_sum", 0.0), metadata.get("since", 0)
        self.best = math.inf if metadata["best"] is None else metadata["best"]


def train(
    config: TrainingConfig,
    source: Source,
    validation: Samples,
    folder: str | Path | None = None,
    *,
    initial: Training | None = None,
    max_seconds: float | None = None,
    progress: bool = True,
    on_validation: Callable[[list[dict[str, float]]], None] | None = None,
) -> Training:
    """Train a network, resuming from `folder` where an earlier run was interrupted.

    Parameters
    ----------
    source, validation:
        Training and held-out images; validation is never trained on.
    folder:
        Keeps ``last.safetensors`` (weights, average, optimiser, step, log), ``best.safetensors`` (the same at the best
        validation) and ``log.csv``; None keeps nothing.
    initial:
        Start from the weights of this training, for fine-tuning; its provenance is kept under ``before``.
    max_seconds:
        Stop (resumably) after this long.
    on_validation:
        Called with the log after every validation: live curves.

    Raises
    ------
    ValueError
        For an empty data set, an `initial` training of another network, or a folder that holds another training, one of
        other data, or one that began from other weights.
    """
    if len(source) == 0 or len(validation) == 0:
        raise ValueError("source and validation: must not be empty; give labelled images.")
    if initial is not None and initial.network.config != config.network:
        raise ValueError(
            f"initial: is a network {initial.network.config}, the configuration asks for {config.network}; make them equal."
        )
    run = _Run(config, initial.network if initial is not None else None)
    provenance: dict[str, object] = {
        "data": source.fingerprint,
        "images": len(source),
        "commit": commit_id(),
        "machine": machine(),
        "torch": torch.__version__,
    }
    if run.world > 1:
        provenance["processes"] = run.world
    if initial is not None:
        provenance |= {"before": initial.provenance, "initial": _weights_fingerprint(initial.network)}
    if folder is not None:
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "last.safetensors").exists():
            run.restore(folder / "last.safetensors", provenance)
    keeps = folder is not None and run.rank == 0
    began, before = time.perf_counter(), run.seconds
    quiet = not progress or run.rank > 0
    bar = tqdm(total=config.steps, initial=run.step, disable=quiet, unit="step", mininterval=1.0)
    stale = _stale(run.log)
    try:
        while run.step < config.steps and not (config.patience and stale >= config.patience):
            run.loss_sum += run.advance(_batch(source, config, run.step, run.rank))
            run.since += 1
            bar.update()
            run.seconds = before + time.perf_counter() - began
            stop = run.agreed(max_seconds is not None and time.perf_counter() - began > max_seconds)
            due = run.step % config.validate_every == 0 or run.step == config.steps
            if not (due or stop):
                continue
            if keeps and not due:  # without the validation below, which a run that is not stopped does not have
                run.save(folder / "last.safetensors", provenance)
            row = {"step": run.step, "seconds": round(run.seconds, 1), "loss": run.loss_sum / run.since}
            row |= validate(run.usable, validation, config)
            run.log.append(row)
            better = row["validation_loss"] < run.best
            bar.set_postfix(loss=f"{row['loss']:.3f}", pck=f"{row['pck_0.05']:.1f}", median=f"{row['median_px']:.2f}px")
            if due:
                run.loss_sum, run.since = 0.0, 0
                run.best, stale = (row["validation_loss"], 0) if better else (run.best, stale + 1)
            if keeps and due:
                provenance["metrics"] = row
                # The last one says what is the best: were it written first, a crash between the two would lose the best.
                for name in ("best", "last") if better else ("last",):
                    run.save(folder / f"{name}.safetensors", provenance)
                _write_log(folder / "log.csv", run.log)
            if on_validation is not None and run.rank == 0:
                on_validation(run.log)
            if stop:
                break
    finally:
        bar.close()
    provenance |= {"metrics": run.log[-1] if run.log else {}, "seconds": run.seconds, "steps": run.step}
    return Training(copy.deepcopy(run.usable).cpu().eval(), run.log, provenance)


def load_training(path: str | Path) -> Training:
    """The network of a training's checkpoint, finished or not.

    Raises
    ------
    FileNotFoundError, ValueError
        Naming the file.
    """
    tensors, metadata = read_checkpoint(path, FORMAT)
    prefix = "average." if any(name.startswith("average.") for name in tensors) else "network."
    network = load_network(path, metadata["config"]["network"], _part(tensors, prefix)).eval()
    return Training(
        network,
        metadata["log"],
        metadata["provenance"]
        | {"steps": metadata["step"], "seconds": metadata["seconds"], "config": metadata["config"]},
    )


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _config(path: Path, values: dict) -> TrainingConfig:
    """A checkpoint's configuration; what it does not name, since it is older, is as by default."""
    try:
        augmentation = values["augmentation"] | {"zoom": tuple(values["augmentation"]["zoom"])}
        parts = {"network": config_of(values["network"]), "augmentation": Augmentation(**augmentation)}
        return TrainingConfig(**values | parts)
    except (TypeError, KeyError) as error:
        raise ValueError(f"{path}: its configuration is not one of this program ({error}).") from error


def _weights_fingerprint(network: nn.Module) -> str:
    digest = hashlib.sha256()
    for tensor in network.state_dict().values():
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _stale(log: list[dict[str, float]]) -> int:
    """Validations since the best one."""
    return len(log) - 1 - int(np.argmin([row["validation_loss"] for row in log])) if log else 0


def _write_log(path: Path, log: list[dict[str, float]]) -> None:
    partial = path.with_name(path.name + ".partial")
    with partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(log[0]))
        writer.writeheader()
        writer.writerows(log)
    os.replace(partial, path)


def main(argv: list[str] | None = None) -> int:
    """`python3 -m lib train`: generate data, train one stage (resuming), or join the trained stages into a detector."""
    from lib.training import assembly
    from lib.training import samples as dataset

    parser = argparse.ArgumentParser(prog="python3 -m lib train", description=main.__doc__.split(": ", 1)[1])
    parser.add_argument(
        "what",
        choices=["generate", "frame", "tool", "window", "closeup", "whole", "assemble", "export"],
        help="data; a stage of the shipped detector; the paper's one network on crops; the detector; its stages as ONNX",
    )
    parser.add_argument("--data", type=Path, default=paths.CACHE / "landmarks", help="folder of the shards")
    parser.add_argument("--folder", type=Path, default=paths.CACHE / "training", help="checkpoints, one folder a stage")
    parser.add_argument("--shards", type=int, default=120, help="generate: training shards of 16 frames")
    parser.add_argument(
        "--windows", type=int, default=60, help="generate: training shards of 512 windows round a landmark"
    )
    parser.add_argument(
        "--closeups", type=int, default=24, help="generate: training shards of 2048 closeups of a landmark"
    )
    parser.add_argument("--workers", type=int, help="generate: processes (default: one a core)")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="best")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--rate", type=float, help="learning rate (default: the preset's)")
    parser.add_argument("--position-weight", type=float, default=0.04, help="window: of the position loss, per px")
    parser.add_argument("--features", type=int, default=None, help="channels (default: the shipped detector's)")
    parser.add_argument("--stacks", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--initial", type=Path, help="checkpoint to fine-tune from")
    parser.add_argument("--out", type=Path, default=paths.MODELS / "default.safetensors", help="assemble: weights file")
    parser.add_argument(
        "--recordings",
        type=Path,
        nargs="*",
        default=[],
        help="assemble: labelled recordings that the covariances are fitted on",
    )
    parser.add_argument("--note", action="append", default=[], help="assemble: a line for the card; may be repeated")
    parser.add_argument("--onnx", type=Path, default=paths.CACHE / "onnx", help="export: folder of the ONNX files")
    parser.add_argument("--threads", type=int, default=0, help="torch threads (default: torch's choice)")
    a = parser.parse_args(argv)
    if a.threads:
        torch.set_num_threads(a.threads)
    try:
        if a.what == "generate":
            dataset.generate(a.data, max(3, a.shards // 15), validation=True, workers=a.workers)
            dataset.generate(a.data, a.shards, workers=a.workers)
            dataset.generate_crops(a.data, a.windows, "windows", workers=a.workers)
            dataset.generate_crops(a.data, a.closeups, "closeups", workers=a.workers)
        elif a.what == "assemble":
            assembly.assemble(a.folder, a.data, a.out, a.recordings, a.note)
        elif a.what == "export":
            from lib.landmarks.export import export_shipped  # needs onnx, which nothing else does

            for stage, (path, difference) in export_shipped(a.out, a.onnx).items():
                print(f"{stage}: {path}, at most {difference:.2g} px from torch")
        else:
            features = a.features or {"frame": 32, "tool": 48, "window": 96, "closeup": 32, "whole": 64}[a.what]
            config = replace(
                PRESETS[a.preset],
                network=OffsetConfig(features) if a.what == "closeup" else HourglassConfig(features, a.stacks),
                steps=a.steps,
                seed=a.seed,
                validate_every=200,
            )
            if a.rate:
                config = replace(config, learning_rate=a.rate)
            if a.what == "window":
                config = replace(config, position_weight_per_px=a.position_weight)
            source: Source
            if a.what == "frame":
                config = replace(config, network=replace(config.network, depth=3), batch_size=8, ema=0.995)
                source = dataset.frame_samples(a.data)
                validation = dataset.frame_samples(a.data, validation=True)
            elif a.what == "tool":
                source = dataset.WindowSource.load_tools(a.data)
                validation = Samples.drawn(dataset.WindowSource.load_tools(a.data, validation=True))
                config = replace(config, augmentation=AUGMENTATIONS["windows"], ema=0.995)
            elif a.what == "window":
                # The simulator varies the magnification itself.
                source = replace(dataset.WindowSource.load(a.data), zoom=(0.9, 1.1))
                validation = Samples.drawn(dataset.WindowSource.load(a.data, validation=True))
                config = replace(config, augmentation=AUGMENTATIONS["windows"])
            elif a.what == "closeup":
                source = dataset.CloseupSource.load(a.data)
                validation = Samples.drawn(dataset.CloseupSource.load(a.data, validation=True))
                config = replace(config, augmentation=AUGMENTATIONS["closeups"], batch_size=64, clip=2.0)
            else:
                source = dataset.simulated_samples(400, seed=a.seed, crop_px=512, progress=True)
                validation = dataset.simulated_samples(40, seed=a.seed + 10_000, crop_px=512)
            initial = load_training(a.initial) if a.initial else None
            print(train(config, source, validation, a.folder / a.what, initial=initial).provenance["metrics"])
    except KeyboardInterrupt:
        print("\nStopped; the same command goes on from the last checkpoint.", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":  # for torchrun
    sys.exit(main())
