"""Engines that run a network: torch, on a CPU or an NVIDIA GPU, or OpenVINO, which is faster on a CPU in the same precision.

``"openvino"`` computes in bfloat16 if the processor has matrix units for it (AMX), else in float32: without them
bfloat16 is no faster, as the recorded table of the detector's speed shows.  bfloat16 changes heatmaps by about 1 % of
their height.  ``"cuda"`` computes in TF32.
"""

import importlib.util
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from lib import files, paths
from lib.landmarks.checkpoints import checksum
from lib.landmarks.network import Network

ENGINES = ("torch", "cuda", "openvino", "openvino float32", "openvino bfloat16")
_BATCH = 6  # images in one inference request
_FREQUENT, _ANY_SHAPE = 300, (-1, 3, -1, -1)  # for a shape that is used more often, compiling for it alone pays
_uses: Counter = Counter()  # (digest of the network, shape of the input) -> number of inferences
_lock = threading.Lock()


def openvino():
    """Import OpenVINO without its telemetry package, which would report every import to its makers."""
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino

    return openvino


def default_engine() -> str:
    """``"cuda"`` if there is an NVIDIA GPU, else ``"openvino"`` if it is installed, else ``"torch"``.

    >>> default_engine() in ENGINES
    True
    """
    return "cuda" if torch.cuda.is_available() else "openvino" if importlib.util.find_spec("openvino") else "torch"


def accelerated(network: Network, engine: str, *, mirror: bool = False) -> Callable[[Tensor], list[Tensor]]:
    """Returns the network as a function for inference: it takes images (n, 3, h, w) and returns [output of `LastOutput`].

    Raises ValueError for an unknown engine, or one that this machine lacks.
    """
    if engine not in ENGINES:
        raise ValueError(f"engine: {engine!r} is unknown; choose one of {', '.join(ENGINES)}.")
    if engine.startswith("openvino"):
        if not importlib.util.find_spec("openvino"):
            raise ValueError("engine: openvino is not installed here; choose 'torch'.")
        has_amx = torch.cpu.get_capabilities().get("amx_bf16", False)
        bfloat16 = {"openvino float32": False, "openvino bfloat16": True}.get(engine, has_amx)
        return OpenVinoNetwork(network, mirror=mirror, precision="bf16" if bfloat16 else "f32")
    if engine == "cuda" and not torch.cuda.is_available():
        raise ValueError("engine: torch sees no NVIDIA GPU here; choose 'torch'.")
    device = "cuda" if engine == "cuda" else "cpu"
    # The cache builds it on the first call.
    last = cache(lambda: LastOutput(network, mirror=mirror).to(device, memory_format=torch.channels_last))
    return lambda images: [last()(images.to(device)).cpu()]


class LastOutput(nn.Module):
    """A network, fused for inference, that returns its last output alone (of an hourglass the last heatmaps).

    With `mirror` it also runs on the image with top and bottom exchanged, mirrors that output back, exchanges the tips
    (tip_1 is the left one), and returns the mean.  The height must be a multiple of the stride, so that the cells coincide.
    """

    def __init__(self, network: Network, *, mirror: bool = False):
        super().__init__()
        self.network, self.mirror = network.fused().to(memory_format=torch.contiguous_format), mirror

    def forward(self, images: Tensor) -> Tensor:
        if not self.mirror:
            return self.network(images)[-1]
        upright, mirrored = self.network(torch.cat([images, images.flip(-2)]))[-1].chunk(2)
        return (upright + mirrored.flip(-2)[:, [0, 2, 1]]) / 2


@dataclass(frozen=True)
class OpenVinoNetwork:
    """A network run by OpenVINO with as many threads as torch uses, a few images at once.

    It is converted once, and compiled for inputs of any shape.  For a frequent shape, and in bfloat16 for every shape, it is
    also compiled for that shape alone, which is a few percent faster; in float32 both outputs agree to rounding.
    """

    network: Network = field(compare=False)
    mirror: bool = False
    precision: str = "f32"
    threads: int = field(default_factory=torch.get_num_threads)
    digest: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "digest", checksum(self.network.state_dict(), {"config": repr(self.network.config)}))

    def __call__(self, images: Tensor) -> list[Tensor]:
        x = np.ascontiguousarray(images.numpy())
        if x.ndim != 4 or x.shape[1] != 3:
            return self.network(images)  # raises the error
        (h, w), outputs = x.shape[2:], []
        multiple, stride = (getattr(self.network.config, name, 1) for name in ("multiple", "stride"))
        x = np.pad(x, ((0, 0), (0, 0), (0, 0 if self.mirror else -h % multiple), (0, -w % multiple)))  # as the network pads
        with _lock:  # threads share the requests
            for part in np.array_split(x, range(_BATCH, len(x), _BATCH)):
                _uses[self.digest, part.shape] += 1
                own = self.precision != "f32" or part.shape[2] % multiple or _uses[self.digest, part.shape] > _FREQUENT
                output = _request(self, part.shape if own else _ANY_SHAPE).infer({0: part})[0]
                outputs.append(output[..., : -(-h // stride), : -(-w // stride)].copy())  # all of an offset network's (n, 4)
        return [torch.from_numpy(np.concatenate(outputs))]


@lru_cache(maxsize=64)  # networks with equal weights are equal keys, so copies of a detector share the compiled models
def _request(compiled: OpenVinoNetwork, shape: tuple[int, ...]) -> object:
    model = _converted(compiled).clone()
    model.reshape(list(shape))
    options = {"PERFORMANCE_HINT": "LATENCY", "NUM_STREAMS": 1, "INFERENCE_NUM_THREADS": compiled.threads}
    options |= {"INFERENCE_PRECISION_HINT": compiled.precision}
    return openvino().Core().compile_model(model, "CPU", options).create_infer_request()


@lru_cache(maxsize=16)
def _converted(compiled: OpenVinoNetwork) -> object:
    """Convert the network to a model that can be reshaped.  That takes seconds; a folder for this code caches the result."""
    depends_on = __file__, Path(__file__).with_name("network.py"), paths.ROOT / "lib" / "environment.lock"
    folder = paths.CACHE / "openvino" / files.digest(*depends_on)
    kept = folder / f"{compiled.digest[:16]}{'-mirror' * compiled.mirror}.xml"
    if kept.is_file():
        with suppress(RuntimeError):  # a damaged file: convert again
            return openvino().Core().read_model(kept)
    shape = (2, 3, *2 * (getattr(compiled.network.config, "size_px", 128),))
    module = LastOutput(compiled.network, mirror=compiled.mirror).eval()
    with torch.no_grad(), warnings.catch_warnings(action="ignore"):  # they say that tracing fixes the shape; `reshape` can
        traced = torch.jit.freeze(torch.jit.trace(module, torch.zeros(shape), check_trace=False))
        model = openvino().convert_model(traced, input=[(list(shape), np.float32)])  # much faster from a trace
    with suppress(OSError, RuntimeError):  # if the disk is full, the next process converts again
        folder.mkdir(parents=True, exist_ok=True)
        with files.whole(kept) as graph, files.whole(kept.with_suffix(".bin")) as weights:  # the graph appears last
            openvino().serialize(model, graph, weights)
    return model
