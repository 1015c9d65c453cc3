"""What decides a training: network, augmentation, optimiser, schedule; and the presets."""

import json
import math
from dataclasses import asdict, dataclass, field

from lib.landmarks.heatmaps import SIGMA_PX
from lib.landmarks.network import HourglassConfig, OffsetConfig
from lib.training.augmentation import AUGMENTATIONS, Augmentation

__all__ = ["PRESETS", "TrainingConfig"]


@dataclass(frozen=True)
class TrainingConfig:
    """All options of a training except its data.

    Attributes:
        optimiser: ``"rmsprop"`` (alpha 0.99, no momentum, as the paper prints) or ``"adamw"``.
        schedule: Of the learning rate: ``"constant"``, or ``"cosine"`` after a warm-up.
        ema: Decay of the moving average of the weights, which is validated and returned; 0 = the weights themselves.
        clip: Largest norm of the gradient; 0 = unlimited.
        precision: ``"fp32"``, or ``"bf16"``: mixed precision where the processor computes in it; the loss is always float32.
        sigma_px: Width of the target Gaussians in pixels of the network's input.
        position_weight_per_px: Weight of `position_loss` beside the l2 loss of the heatmaps; 0 as in the paper.
        seed: Decides the first weights and every batch.

    Raises:
        ValueError: For an unknown choice, or a number below 1 where at least 1 is needed.

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
    position_weight_per_px: float = 0.0
    validate_every: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        known = {"optimiser": ("rmsprop", "adamw"), "schedule": ("constant", "cosine"), "precision": ("fp32", "bf16")}
        for name, choices in known.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}.")
        if min(self.steps, self.batch_size, self.validate_every) < 1:
            raise ValueError("steps, batch_size, validate_every: must be at least 1.")

    def rate(self, step: int, spent: float = 0.0) -> float:
        """Learning rate of a step; `spent` is the share of the time that has passed, if time ends the training."""
        if self.schedule == "constant":
            return self.learning_rate
        warm = min(1.0, (step + 1) / max(1, min(100, self.steps // 10)))
        done = max(step / self.steps, min(spent, 1.0))
        return self.learning_rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))

    def changed(self, stored: dict[str, object]) -> list[str]:
        """Names of the options whose values differ in a checkpoint's configuration; what it does not name has its default.

        `validate_every` may differ between two sittings of one training.
        """
        own, other = (json.loads(json.dumps(asdict(c))) for c in (self, TrainingConfig(type(self.network)())))
        other |= stored | {part: other[part] | stored.get(part, {}) for part in ("network", "augmentation")}
        return [name for name, value in other.items() if name != "validate_every" and own.get(name) != value]


#: `paper`: as printed. `best`: trains the shipped networks.
PRESETS = {
    "paper": TrainingConfig(),
    "best": TrainingConfig(
        augmentation=AUGMENTATIONS["best"], batch_size=12, optimiser="adamw", learning_rate=2e-3, schedule="cosine",
        ema=0.998, clip=1.0, precision="bf16",
    ),
}
