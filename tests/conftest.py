"""What every test runs under: few threads, no display, reproducible examples."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # before numpy and torch are imported; every core has tests of its own
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")

import hypothesis
import pytest

import lib.workbench  # noqa: F401 - before nbformat: it spares each process seconds

#: The files that take longest, from about 20 to 4 s of the processor: they go first, so that no worker begins one last.
LONGEST = (
    "adapt/test_adapt.py", "training/test_loop.py", "online/test_faults.py", "test_notebooks.py",
    "test_notebooks_course.py", "landmarks/test_shipped.py", "calibration/test_estimate.py", "online/test_pipeline.py",
    "studies/test_calibration.py", "simulator/test_dataset.py", "workbench/test_run.py", "calibration/test_robust.py",
    "landmarks/test_export.py", "importing/test_import.py", "test_readme.py", "landmarks/test_detector.py",
    "workbench/test_sweep.py", "training/test_error_models.py", "training/test_command.py",
)  # fmt: skip

hypothesis.settings.register_profile("microstereo", derandomize=True, deadline=None, max_examples=50, database=None)
hypothesis.settings.load_profile("microstereo")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="also run the tests marked slow")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    order = {Path(__file__).parent / name: rank for rank, name in enumerate(LONGEST)}
    assert all(path.is_file() for path in order), "LONGEST names a file that is gone"
    items.sort(key=lambda item: order.get(item.path, len(order)))
    cuda = shutil.which("nvidia-smi") is not None and _torch_sees_cuda()
    for item in items:
        if "slow" in item.keywords and not config.getoption("--slow"):
            item.add_marker(pytest.mark.skip(reason="slow: give --slow"))
        if "cuda" in item.keywords and not cuda:
            item.add_marker(pytest.mark.skip(reason="no NVIDIA GPU"))


def _torch_sees_cuda() -> bool:
    import torch

    return torch.cuda.is_available()
