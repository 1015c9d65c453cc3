"""Training a network: its configuration, batches, losses, optimiser, validation, checkpoints with exact resume.

All randomness of step t comes from a generator seeded with (seed, t).  A run that was interrupted and resumed therefore
equals one that was not, bit for bit on the CPU: the step number determines all random numbers.
"""

import copy
import json
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn
from tqdm.auto import tqdm

from lib.geometry import check
from lib.landmarks.checkpoints import checksum, load_network, read_checkpoint, with_prefix, write_checkpoint
from lib.landmarks.error_model import closeup_peaks
from lib.landmarks.heatmaps import SIGMA_PX, decode, render, sigma_cells
from lib.landmarks.metrics import score, tool_length_px
from lib.landmarks.network import HourglassConfig, Network, OffsetConfig, OffsetNetwork, network_of
from lib.parallel import cores, quick_turns
from lib.provenance import commit_id, machine
from lib.training.augmentation import AUGMENTATIONS, Augmentation, Batch, leave_frame
from lib.training.samples import Samples, Source

FORMAT = "microstereo.training"
#: Attributes of a `Run` that a checkpoint stores beside its tensors.
_STATE = ("step", "seconds", "log", "loss_sum", "since")
_OPTIMISERS = {
    "rmsprop": partial(torch.optim.RMSprop, alpha=0.99),
    "adamw": partial(torch.optim.AdamW, weight_decay=1e-4, fused=True),
}
#: Time between checkpoints, so the most that a killed training loses.
_SAVE_EVERY_S = 50.0


@dataclass(frozen=True)
class TrainingConfig:
    """All options of a training except its data.

    Attributes:
        optimiser: ``"rmsprop"`` (alpha 0.99, no momentum, as the paper prints) or ``"adamw"``.
        schedule: Schedule of the learning rate: ``"constant"``, or ``"cosine"`` after a warm-up.
        ema: Decay of the moving average of the weights, which is validated and returned; 0 = the weights themselves.
        clip: Largest norm of the gradient; 0 = unlimited.
        precision: ``"fp32"``, or ``"bf16"``: mixed precision if the processor supports it; the loss is always float32.
        sigma_px: Standard deviation of the target Gaussians in pixels of the network's input.
        seed: Determines the initial weights and every batch.

    Raises ValueError for an unknown choice, or a number below 1 where at least 1 is needed.

    >>> TrainingConfig(steps=1000, learning_rate=1e-3, schedule="cosine").rate(500)
    0.000505
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
    validate_every: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        known = {"optimiser": tuple(_OPTIMISERS), "schedule": ("constant", "cosine"), "precision": ("fp32", "bf16")}
        for name, choices in known.items():
            check(self, name, choices.__contains__, f"expected one of {', '.join(choices)}")
        check(self, "steps batch_size validate_every", lambda v: v >= 1, "must be at least 1")

    def rate(self, step: int, spent: float = 0.0) -> float:
        """Learning rate of a step; `spent` is the share of the time limit that has passed, if there is a limit."""
        if self.schedule == "constant":
            return self.learning_rate
        warm = min(1.0, (step + 1) / max(1, min(100, self.steps // 10)))
        done = max(step / self.steps, min(spent, 1.0))
        return self.learning_rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))

    def changed(self, stored: dict[str, object]) -> list[str]:
        """Names of the options that differ from a checkpoint's configuration, in which missing options have their defaults.

        `validate_every` may differ when a training is resumed.  Options that no longer exist must be 0 in the checkpoint.
        """
        own, other = (json.loads(json.dumps(asdict(c))) for c in (self, TrainingConfig(type(self.network)())))
        other |= stored | {part: other[part] | stored.get(part, {}) for part in ("network", "augmentation")}
        return [name for name, value in other.items() if name != "validate_every" and own.get(name, 0) != value]


#: `paper`: as printed. `best`: trains the shipped networks, each with the augmentation of its stage (`stage_config`).
PRESETS = {
    "paper": TrainingConfig(),
    "best": TrainingConfig(
        batch_size=12, optimiser="adamw", learning_rate=2e-3, schedule="cosine", ema=0.998, clip=1.0, precision="bf16",
    ),
}


@dataclass(frozen=True)
class Training:
    """The result of a finished or stopped training: the network, one log row per validation, and the provenance."""

    network: Network
    log: list[dict[str, float]]
    provenance: dict[str, object]


def draw_batch(source: Source, config: TrainingConfig, step: int, rank: int = 0) -> tuple[object, ...]:
    """Draw images (n, h, w, 3) uint8, u (n, 3, 2) px, visibility (n, 3) of a step; also returns the generator for `prepared`.

    `rank` is the index of this process among those that train together.
    """
    rng = np.random.default_rng([config.seed, step, *([rank] if rank else [])])
    indices = rng.choice(len(source), config.batch_size, replace=len(source) < config.batch_size)
    return *map(np.stack, zip(*(source.draw(int(i), rng) for i in indices), strict=True)), rng


def prepared(drawn: Sequence, config: TrainingConfig, device: torch.device | str = "cpu") -> Batch:
    """Augment the result of `draw_batch` on the device that trains."""
    *arrays, rng = drawn
    return config.augmentation(_batch(*arrays, device), rng)


def batches(draw: Callable[[int], tuple], steps: range, threads: int = 0) -> Iterator[tuple]:
    """Yield ``draw(step)`` for each step, in order.  `threads` is the number of threads that draw ahead; 0 = none.

    >>> list(batches(lambda step: (step, step**2), range(3, 6), threads=2))
    [(3, 9), (4, 16), (5, 25)]
    """
    if not threads:
        yield from map(draw, steps)
        return
    left = iter(steps)
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque(pool.submit(draw, step) for step in islice(left, 2 * threads))
        while waiting:
            yield waiting.popleft().result()
            waiting.extend(pool.submit(draw, step) for step in islice(left, 1))


def _batch(images: np.ndarray, u: np.ndarray, visibility: np.ndarray, device: torch.device | str = "cpu") -> Batch:
    """Convert arrays to a batch, in which landmarks outside the image are absent."""
    if images.dtype != np.uint8:
        raise ValueError(f"images: a source draws uint8, got {images.dtype}.")
    images, u, visibility = (torch.as_tensor(part).to(device) for part in (images, u, visibility))
    images, u = images.permute(0, 3, 1, 2).float().div_(255.0).contiguous(), u.float()
    return Batch(images, u, leave_frame(u, visibility.long(), tuple(images.shape[-2:])))


def heatmap_loss(outputs: Sequence[Tensor], batch: Batch, stride: int, sigma_px: float = SIGMA_PX) -> Tensor:
    """Squared error of every stack's heatmaps against the Gaussians, scaled so that empty heatmaps cost 1.

    It is the sum over cells divided by pi sigma^2 (the sum of a squared Gaussian of peak 1), the mean over the landmarks
    that count, and the mean over stacks (intermediate supervision).

    >>> batch = Batch(torch.zeros(1, 3, 96, 96), torch.full((1, 3, 2), 47.5), torch.full((1, 3), 2))
    >>> round(heatmap_loss([torch.zeros(1, 3, 24, 24)], batch, stride=4).item(), 2)
    1.0
    """
    target = render(batch.u.float(), tuple(batch.images.shape[-2:]), stride, sigma_px) * batch.peak[..., None, None]
    scale = math.pi * sigma_cells(stride, sigma_px) ** 2 * batch.weight.sum().clamp_min(1)
    losses = [((output.float() - target).square().sum((-2, -1)) * batch.weight).sum() / scale for output in outputs]
    return torch.stack(losses).mean()


def offset_loss(outputs: Sequence[Tensor], batch: Batch) -> Tensor:
    """Negative log likelihood of an `OffsetNetwork`'s errors under Laplace distributions with the scales that it predicts.

    A closeup without a visible, labelled landmark does not count.  The absolute error is smoothed within 0.1 px.  The Laplace
    distribution gives gross errors little weight; its scale gives sharp images more weight than blurred ones.
    """
    (found,) = outputs
    own = (batch.visibility == 2) & batch.u.isfinite().all(-1)
    there = own.any(1).float()
    true = torch.where(own[..., None], batch.u.float(), 0.0).sum(1) - (batch.images.shape[-1] - 1) / 2
    distance = ((found[:, :2].float() - true).square() + 0.01).sqrt()
    log_scale = found[:, 2:].float()
    return ((log_scale + distance * (-log_scale).exp()).sum(1) * there).sum() / there.sum().clamp_min(1)


def _loss(network: Network, outputs: Sequence[Tensor], batch: Batch, config: TrainingConfig) -> Tensor:
    if isinstance(network, OffsetNetwork):
        return offset_loss(outputs, batch)
    return heatmap_loss(outputs, batch, network.stride, config.sigma_px)


@torch.no_grad()
def validate(network: Network, samples: Samples, config: TrainingConfig) -> dict[str, float]:
    """Loss, PCK and median error on held-out images, and two signs of a collapsed network.

    `peak` is the mean height of the heatmaps of visible landmarks, ideally 1; near 0, the network predicts nothing.  `spread`
    is the standard deviation of the predictions divided by that of the labels; near 0, the network always predicts the same.
    An `OffsetNetwork` has no `peak`.
    """
    network.eval()
    device = next(network.parameters()).device
    losses, found, labels = [], [], []
    for start in range(0, len(samples), 16):
        part = slice(start, start + 16)
        labelled = _batch(samples.images[part], samples.u[part], samples.visibility[part])
        outputs = [output.cpu() for output in network(labelled.images.to(device))]
        losses.append(_loss(network, outputs, labelled, config).item())
        if isinstance(network, OffsetNetwork):
            found.append(closeup_peaks(outputs[-1], labelled.images.shape[-1]))
        else:
            found.append(decode(outputs[-1], network.stride, sigma_px=config.sigma_px))
        labels.append(torch.where((labelled.visibility == 2)[..., None], labelled.u, torch.nan))
    true, seen = torch.cat(labels).double().numpy(), torch.cat(labels).isfinite().all(-1)
    u = torch.cat([peaks.u for peaks in found]).expand(-1, 3, -1).double().numpy()
    scores = score(u, true, length_px=tool_length_px(samples.u))
    spread = np.nanmean(np.nanstd(np.where(seen[..., None], u, np.nan), 0)) / np.nanmean(np.nanstd(true, 0))
    result = {"validation_loss": float(np.mean(losses)), "pck_0.05": scores.pck_0_05, "pck_0.10": scores.pck_0_10}
    result |= {"median_px": scores.median_px, "p95_px": scores.p95_px, "spread": float(spread)}
    if not isinstance(network, OffsetNetwork):
        result["peak"] = torch.cat([peaks.value for peaks in found])[seen].mean().item()
    return result


def average(tensors: Sequence[Tensor], world: int) -> None:
    """Replace tensors, in place, by their means over the processes."""
    together = torch.cat([t.flatten() for t in tensors])
    dist.all_reduce(together)
    together /= world
    for tensor, mean in zip(tensors, together.split([t.numel() for t in tensors]), strict=True):
        tensor.copy_(mean.view_as(tensor))


class Run:
    """The state of a training, which can be saved and restored: weights, optimiser, step and log."""

    def __init__(self, config: TrainingConfig, initial: Network | None = None):
        self.config = config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = copy.deepcopy(initial) if initial is not None else network_of(config.network)
        # torchrun starts the processes that train together, and gives their number in the environment.
        self.rank, self.world = 0, int(os.environ.get("WORLD_SIZE", "1"))
        if self.world > 1:
            if not dist.is_initialized():
                dist.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
            self.rank = dist.get_rank()
        gpu = f"cuda:{os.environ.get('LOCAL_RANK', '0') if self.world > 1 else 0}"
        self.device = torch.device(gpu if torch.cuda.is_available() else "cpu")
        # A processor without bfloat16 arithmetic emulates it, which takes eight times as long.
        fast = self.device.type == "cuda" or any(map(torch.cpu.get_capabilities().get, ("avx512_bf16", "amx_bf16")))
        self.mixed = config.precision == "bf16" and fast
        self.network.to(self.device, memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.network) if config.ema else None
        self.usable = self.average or self.network
        self.optimiser: torch.optim.Optimizer = _OPTIMISERS[config.optimiser](self.network.parameters(), config.learning_rate)
        self.forward: Callable[[Tensor], list[Tensor]] | None = None
        self.step, self.seconds, self.log, self.loss_sum, self.since = 0, 0.0, [], 0.0, 0  # both since the last validation

    def advance(self, batch: Batch, spent: float = 0.0) -> None:
        """Train one step on a batch, which must be on the device; `spent` as in `TrainingConfig.rate`."""
        self.network.train()
        self.optimiser.param_groups[0]["lr"] = self.config.rate(self.step, spent)
        images = batch.images.contiguous(memory_format=torch.channels_last)
        graphs = self.device.type == "cuda"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.mixed, cache_enabled=not graphs):
            if self.forward is None:
                self.forward = self._graphed(images) if graphs and self.world == 1 else self.network
            outputs = self.forward(images)
        loss = _loss(self.network, outputs, batch, self.config)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        if self.world > 1:
            with torch.no_grad():
                average([p.grad for p in self.network.parameters() if p.grad is not None], self.world)
                average([b for b in self.network.buffers() if b.is_floating_point()], self.world)
        if self.config.clip:
            nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip)
        self.optimiser.step()
        if self.average is not None:
            # The decay is smaller in the first steps, so that the average forgets the random initial weights.
            decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
            pairs = zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True)
            means, values = zip(*(pair for pair in pairs if pair[0].is_floating_point()), strict=True)  # counts are not read
            get_ema_multi_avg_fn(decay)(means, values, None)
        self.step += 1
        self.loss_sum, self.since = self.loss_sum + loss.item(), self.since + 1

    def _graphed(self, images: Tensor) -> Callable[[Tensor], list[Tensor]]:
        """Capture the network as CUDA graphs: a step has a thousand kernels, which take longer to launch than to run."""
        before = copy.deepcopy(self.network.state_dict())  # a capture changes the statistics of batch normalisation
        torch.autograd.graph.set_warn_on_accumulate_grad_stream_mismatch(False)  # meaningless for a capture
        graphed = torch.cuda.make_graphed_callables(copy.copy(self.network), (images,))
        self.network.load_state_dict(before)
        return graphed

    def save(self, path: Path, provenance: dict[str, object]) -> None:
        """Write everything that `restore` needs."""
        tensors = {f"network.{k}": v for k, v in self.network.state_dict().items()}
        if self.average is not None:
            tensors |= {f"average.{k}": v for k, v in self.average.state_dict().items()}
        for i, values in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{i}.{k}": torch.as_tensor(v) for k, v in values.items()}
        state = {name: getattr(self, name) for name in _STATE}
        write_checkpoint(path, tensors, {"format": FORMAT, "config": asdict(self.config), "provenance": provenance} | state)

    def restore(self, path: Path, provenance: dict[str, object]) -> None:
        """Load the state from a checkpoint, and complete `provenance`.  Raises ValueError if it is another training's."""
        tensors, metadata = read_checkpoint(path, FORMAT)
        changed, kept = self.config.changed(metadata["config"]), metadata["provenance"]
        processes = kept.get("processes", 1)
        for differs, how in (
            (changed, f"belongs to a training with another {', '.join(changed)};"),
            (kept["data"] != provenance["data"], "was trained on other data (fingerprint differs);"),
            (provenance.get("initial") not in (None, kept.get("initial")), "was begun from other weights;"),
            (processes != self.world, f"was begun by {processes} process(es), now {self.world}; start as many, or"),
        ):
            if differs:
                raise ValueError(f"{path}: {how} use another folder.")
        provenance |= {key: kept[key] for key in ("initial", "before", "metrics") if key in kept}
        self.network.load_state_dict(with_prefix(tensors, "network."))
        if self.average is not None:
            self.average.load_state_dict(with_prefix(tensors, "average."))
        own = ((i, with_prefix(tensors, f"optimiser.{i}.")) for i, _ in enumerate(self.network.parameters()))
        self.optimiser.load_state_dict(self.optimiser.state_dict() | {"state": {i: state for i, state in own if state}})
        for weight, values in self.optimiser.state.items():  # the fused optimiser needs the weight's order in memory
            values |= {k: torch.empty_like(weight).copy_(v) for k, v in values.items() if v.shape == weight.shape}
        for name in _STATE:
            setattr(self, name, metadata[name])


@quick_turns()
def train(
    config: TrainingConfig, source: Source, validation: Samples, folder: str | Path | None = None, *,
    initial: Training | None = None, max_seconds: float | None = None, progress: bool | Callable[[float], None] = True,
) -> Training:  # fmt: skip
    """Train a network, or resume an interrupted training in `folder`.

    Args:
        source, validation: Training images and held-out images.
        folder: Where ``last.safetensors`` (weights, average, optimiser, step, log) is written; None = nothing is written.
        initial: A training from whose weights to start, for fine-tuning; its provenance is kept under ``before``.
        max_seconds: Stop after this time, in s; a cosine schedule ends then.  The training can be resumed.
        progress: True = show a progress bar.  A function is called with the share that is done.

    Raises ValueError for an empty data set, an `initial` of another network, or a folder that holds another training.
    """
    if not len(source):
        raise ValueError("source: must not be empty; give labelled images.")
    if initial is not None and initial.network.config != config.network:
        raise ValueError(f"initial: is a network {initial.network.config}, not {config.network} as the configuration asks.")
    run = Run(config, initial.network if initial is not None else None)
    provenance: dict[str, object] = {"data": source.fingerprint, "images": len(source), "torch": torch.__version__}
    precision = {"precision": "bf16" if run.mixed else "fp32"}
    provenance |= {"commit": commit_id(), "machine": machine(), "processes": run.world} | precision
    if initial is not None:
        provenance |= {"before": initial.provenance, "initial": checksum(initial.network.state_dict(), {})[:16]}
    last = Path(folder) / "last.safetensors" if folder is not None else None
    if last is not None:
        last.parent.mkdir(parents=True, exist_ok=True)
        if last.exists():
            run.restore(last, provenance)
    keeps = last is not None and run.rank == 0
    began, before, stop, saved = time.perf_counter(), run.seconds, False, time.perf_counter()
    # A GPU trains faster than one thread draws.
    threads = max(1, cores() // int(os.environ.get("LOCAL_WORLD_SIZE", "1")) - 1) if run.device.type == "cuda" else 0
    drawn = batches(partial(draw_batch, source, config, rank=run.rank), range(run.step, config.steps), threads)
    with tqdm(total=config.steps, initial=run.step, disable=progress is not True or run.rank > 0, unit="step") as bar:
        while run.step < config.steps and not stop:
            spent = (time.perf_counter() - began) / max_seconds if max_seconds else 0.0
            run.advance(prepared(next(drawn), config, run.device), spent)
            bar.update()
            if callable(progress):
                progress(min(1.0, max(run.step / config.steps, spent)))
            run.seconds = before + time.perf_counter() - began
            stop = max_seconds is not None and time.perf_counter() - began > max_seconds
            if run.world > 1:  # clocks differ, and all must stop together
                flag = torch.tensor(float(stop), device=run.device)
                dist.broadcast(flag, 0)
                stop = bool(flag)
            due = run.step % config.validate_every == 0 or run.step == config.steps
            if (stop or time.perf_counter() - saved > _SAVE_EVERY_S) and keeps and not due:
                run.save(last, provenance)  # without the validation below, which an uninterrupted run does not have
                saved = time.perf_counter()
            if stop or due:
                row = {"step": run.step, "seconds": round(run.seconds, 1), "loss": run.loss_sum / run.since}
                run.log.append(row | validate(run.usable, validation, config))
                bar.set_postfix({name: f"{run.log[-1][name]:.3g}" for name in ("loss", "pck_0.05", "median_px")})
            if due:
                run.loss_sum, run.since, provenance["metrics"] = 0.0, 0, run.log[-1]
                if keeps:
                    run.save(last, provenance)
    provenance |= {"metrics": run.log[-1] if run.log else {}, "seconds": run.seconds, "steps": run.step}
    return Training(copy.deepcopy(run.usable).cpu().eval(), run.log, provenance)


def load_training(path: str | Path) -> Training:
    """Load the network from a training's checkpoint, finished or not."""
    tensors, metadata = read_checkpoint(path, FORMAT)
    prefix = "average." if any(name.startswith("average.") for name in tensors) else "network."
    network = load_network(path, metadata["config"]["network"], tensors, prefix).eval()
    more = {"steps": metadata["step"], "seconds": metadata["seconds"], "config": metadata["config"]}
    return Training(network, metadata["log"], metadata["provenance"] | more)
