"""What equal arguments have led to is not worked out a second time: for tests that start alike or go on from one another."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from torch import Tensor

from lib.adapt import alignment
from lib.calibration import estimate
from lib.landmarks import detector
from lib.recordings import Recording, frames
from lib.trust import verdict
from lib.trust.fitting import Problem

Said = TypeVar("Said")


def remembering(function: Callable) -> Callable:
    """The function; what it has found for equal arguments, or refused, it does not work out a second time."""
    known: dict[bytes, tuple] = {}

    def answer(*args, **how):
        try:
            key = hashlib.sha256(pickle.dumps((args, how))).digest()
        except (AttributeError, pickle.PicklingError):  # a function that is nobody's attribute
            return function(*args, **how)
        if key not in known:
            try:
                known[key] = function(*args, **how), None
            except ValueError as error:
                known[key] = None, error
        found, error = known[key]
        if error is not None:
            raise error
        return found

    return answer


@cache
def said_once(function: Callable[..., Said]) -> Callable[..., Said]:
    """A function of a tensor and settings, such as a network; nobody may change what it says, which is worked out once."""
    said: dict[bytes, Said] = {}

    def answer(tensor: Tensor, *more: object, **how: object) -> Said:
        digest = hashlib.sha256(repr((tensor.shape, tensor.stride(), more, how)).encode())
        digest.update(tensor.numpy().ravel(order="K"))  # as it lies in memory, without a copy
        key = digest.digest()
        if key not in said:
            said[key] = function(tensor, *more, **how)
        return said[key]

    return answer


@contextmanager
def remembering_detectors() -> Iterator[None]:
    """In here detectors of the same networks, which nobody trains, share what these say and what that decodes to."""
    accelerated = cache(detector.accelerated)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detector, "accelerated", lambda *network, **how: said_once(accelerated(*network, **how)))
        for name in ("decode", "several_peaks"):
            patch.setattr(detector, name, said_once(getattr(detector, name)))
        patch.setattr(detector, "best_tools", remembering(detector.best_tools))
        yield


@contextmanager
def remembering_teacher() -> Iterator[None]:
    """In here the robot's teacher asks once for the cameras, the clock and the faults of the same rows.

    Cameras of two models start from one consensus.
    """
    asked = {alignment: ("calibrate", "calibrate_as_shown", "diagnose", "estimate_time_offset"), Problem: ("fit",)}
    asked[estimate] = ("consensus",)
    with pytest.MonkeyPatch.context() as patch:
        for where, names in asked.items():
            for name in names:
                patch.setattr(where, name, remembering(getattr(where, name)))
        yield


@contextmanager
def remembering_recordings() -> Iterator[None]:
    """In here an image file that stays as it is is decoded once; the faults of the same rows are sought once, and so are the
    features of the same images.
    """
    read, known = frames.read_image, {}
    match, matched = verdict.feature_matches, {}

    def read_once(path: Path, *how: object) -> np.ndarray:
        if not path.is_file():
            return read(path, *how)
        state = path.stat()
        key = path, state.st_mtime_ns, state.st_size, state.st_ino, how
        if key not in known:
            known[key] = read(path, *how)
            known[key].setflags(write=False)
        return known[key]

    def match_once(recording: Recording, numbers: np.ndarray) -> np.ndarray:
        digest = hashlib.sha256()
        for number in numbers:
            pair = recording.frames[int(number)]
            digest.update(repr(pair.left.shape).encode() + pair.left.tobytes() + pair.right.tobytes())
        key = digest.digest()
        if key not in matched:
            matched[key] = match(recording, numbers)
            matched[key].setflags(write=False)
        return matched[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frames, "read_image", read_once)
        patch.setattr(verdict, "feature_matches", match_once)
        patch.setattr(verdict, "diagnose", remembering(verdict.diagnose))
        yield
