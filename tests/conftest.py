"""What every test runs under: few threads, no display, reproducible examples."""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_variable, "1")  # before numpy and torch are imported; every core has tests of its own
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
os.fsync = lambda file: None  # what tests write need not outlast a crash of the machine

import pytest

TESTS = Path(__file__).parent
#: The files that take longest, from 36 (with those of `TOGETHER`) to 1.1 s of the processor: they go first, so that no
#: worker begins one last.
LONGEST = (
    "landmarks/test_shipped.py", "adapt/test_adapt.py", "trust/test_diagnosis.py", "online/test_faults.py",
    "training/test_loop.py", "online/test_pipeline.py", "test_commands.py", "test_notebooks.py",
    "test_notebooks_course.py", "calibration/test_offsets.py", "importing/test_import.py",
    "surface/test_reconstruct.py", "calibration/test_estimate.py", "simulator/test_dataset.py",
    "workbench/test_run.py", "trust/test_verdict.py", "studies/test_calibration.py",
    "matching/test_stereo_pairs.py", "surface/test_fitting.py", "matching/test_match.py",
    "landmarks/test_detector.py", "calibration/test_robust.py", "registration/test_registration.py",
    "simulator/test_population.py", "trust/test_check.py", "workbench/test_sweep.py",
    "calibration/test_instruments.py", "online/test_beside.py", "training/test_command.py",
    "simulator/test_geometry_of_images.py", "online/test_record.py", "matching/test_deepmatching.py",
    "studies/test_trust.py", "test_parallel.py", "landmarks/test_engines.py", "simulator/test_recordings_made.py",
    "test_house.py", "training/test_drawings.py", "simulator/test_realism.py", "importing/test_malformed.py",
)  # fmt: skip
#: File -> the file whose worker runs it too: what takes seconds to make for one is there for the other.
TOGETHER = {"tests/training/test_error_models.py": "tests/training/test_loop.py"} | dict.fromkeys(  # a trained network
    ("tests/landmarks/test_export.py", "tests/test_readme.py", "tests/studies/test_registration.py",
     "lib/landmarks/detector.py"), "tests/landmarks/test_shipped.py",  # the detector that ships, compiled
)  # fmt: skip


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="also run the tests marked slow")


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput") and config.getoption("numprocesses", None):
        return  # the workers, which wait for this process, run the tests
    from hypothesis import settings

    import lib.workbench  # noqa: F401 - before nbformat: it spares each process seconds

    settings.register_profile("microstereo", derandomize=True, deadline=None, max_examples=50, database=None)
    settings.load_profile("microstereo")
    gc.disable()  # until all is imported


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    order = {TESTS / name: rank for rank, name in enumerate(LONGEST)}
    assert all(path.is_file() for path in order), "LONGEST names a file that is gone"
    gone = [name for pair in TOGETHER.items() for name in pair if not (TESTS.parent / name).is_file()]
    assert not gone, "TOGETHER names files that are gone"
    items.sort(key=lambda item: order.get(item.path, len(order)))
    cuda = shutil.which("nvidia-smi") is not None and _torch_sees_cuda()
    for item in items:
        if "slow" in item.keywords and not config.getoption("--slow"):
            item.add_marker(pytest.mark.skip(reason="slow: give --slow"))
        if "cuda" in item.keywords and not cuda:
            item.add_marker(pytest.mark.skip(reason="no NVIDIA GPU"))


def pytest_collection_finish(session: pytest.Session) -> None:
    """What was imported stays: the garbage collector need not look through it again, nor after every few objects."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object | None:
    """Files go to workers as `TOGETHER` says; any other way of distribution is left to xdist."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return TOGETHER.get(file, file)

    return Scheduling(config, log)


@pytest.fixture(scope="session", autouse=True)
def hidden_gpu() -> Iterator[Callable[[], bool] | None]:
    """What runs in this process expects what a CPU computes, to the last bit.  What sees the GPU is kept for `gpu`."""
    if shutil.which("nvidia-smi") is None:
        yield None
        return
    import torch

    with pytest.MonkeyPatch.context() as patch:
        sees = torch.cuda.is_available
        patch.setattr(torch.cuda, "is_available", lambda: False)
        yield sees


@pytest.fixture
def gpu(hidden_gpu: Callable[[], bool], monkeypatch: pytest.MonkeyPatch) -> None:
    """For a test marked cuda: torch sees the GPU."""
    monkeypatch.setattr("torch.cuda.is_available", hidden_gpu)


def _torch_sees_cuda() -> bool:
    import torch

    return torch.cuda.is_available()
