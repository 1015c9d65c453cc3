"""Provenance of a result: command, commit, machine, date, wall-clock time and CPU time."""

import datetime
import functools
import os
import platform
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil

from lib import files, paths
from lib.parallel import cores

#: The files of the repository that can change a result; results that are being written do not count as modified code.
_CODE = ("lib", "notebooks", "tests", "environment.toml")
_GPU_NAMES = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]


def commit(root: Path = paths.ROOT) -> dict | None:
    """The checked-out commit {"id": ..., "modified": True if the code differs from it}; None outside a git checkout."""
    git = ["git", "-C", str(root)]
    with suppress(OSError, subprocess.CalledProcessError):
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        status = subprocess.run([*git, "status", "--porcelain", "--", *_CODE], capture_output=True, text=True, check=True)
        return {"id": head.stdout.strip(), "modified": bool(status.stdout.strip())}
    return None


def commit_id() -> str:
    """The first 12 characters of the commit, with "+modified" if the code differs; "unknown" outside a git checkout."""
    found = commit()
    return found["id"][:12] + "+modified" * found["modified"] if found else "unknown"


@functools.cache
def machine() -> dict:
    """System, processor, cores that this process may use, memory and GPU."""
    processor = platform.processor() or platform.machine()
    memory_gb, gpu = round(psutil.virtual_memory().total / 1e9, 1), None
    with suppress(OSError):  # not Linux
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), processor)
    with suppress(OSError, subprocess.SubprocessError, IndexError):  # no driver, no answer, or no GPU
        names = subprocess.run(_GPU_NAMES, capture_output=True, text=True, timeout=20, check=True).stdout
        gpu = names.splitlines()[0].strip()
    system = f"{platform.system()} {platform.release()}"
    return {"system": system, "processor": processor, "cores": cores(), "memory_gb": memory_gb, "gpu": gpu}


class Provenance:
    """Create at the start of a measurement; holds the command that repeats it, the commit, and the start of the clocks."""

    def __init__(self, command: str) -> None:
        self.command, self.commit = command, commit()
        self.wall_s, self.cpu_s = time.perf_counter(), sum(os.times()[:4])

    def so_far(self) -> dict[str, object]:
        """The entries for `lib.workbench.results.write`; CPU seconds include finished child processes."""
        return {
            "command": self.command, "commit": self.commit, "machine": machine(),
            "weights": files.digest(paths.MODELS / "default.safetensors"), "date": datetime.date.today().isoformat(),
            "seconds": time.perf_counter() - self.wall_s, "cpu_seconds": sum(os.times()[:4]) - self.cpu_s,
        }  # fmt: skip


def plain(value: object) -> object:
    """A value for JSON: lists instead of arrays and tuples, numbers with 6 digits, None instead of NaN and infinity."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value
