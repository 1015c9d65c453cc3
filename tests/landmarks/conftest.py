"""The shipped detector on the shipped recording, run once for all tests of the room."""

from functools import cached_property

import numpy as np
import pytest

from lib import paths
from lib.landmarks import Detector, Landmarks
from lib.recordings import Recording
from tests.remembering import said_once


def remembering(detector: Detector) -> Detector:
    """The detector itself; its networks answer once."""
    detector._run.update({stage: said_once(run) for stage, run in detector._run.items()})
    return detector


class Shipped:
    """Every fourth stereo frame of the recording, its truth, and the landmarks that each engine finds, in pairs."""

    def __init__(self):
        recording = Recording.open(paths.SHIPPED_RECORDING)
        chosen, truth = range(0, len(recording.frames), 4), recording.truth
        frames = [recording.frames[i] for i in chosen]
        self.images = np.stack([image for frame in frames for image in (frame.left, frame.right)])
        self.ground = recording.ground()
        both = ((truth.u_left, truth.visibility_left), (truth.u_right, truth.visibility_right))
        u, visibility = (np.stack([side[i] for side in both], 1) for i in (0, 1))
        self.u = u[chosen].reshape(-1, 3, 2)
        self.in_view = visibility[chosen].reshape(-1, 3) > 0

    def found(self, detector: Detector) -> Landmarks:
        return Landmarks.join([detector(self.images[i : i + 2]) for i in range(0, len(self.images), 2)])

    @cached_property
    def torch(self) -> Detector:
        return remembering(Detector.load(engine="torch"))

    @cached_property
    def default(self) -> Detector:
        return remembering(Detector.load())

    @cached_property
    def by_torch(self) -> Landmarks:
        return self.found(self.torch)

    @cached_property
    def by_default(self) -> Landmarks:
        return self.found(self.default)


@pytest.fixture(scope="session")
def shipped():
    if not ((paths.MODELS / "default.safetensors").is_file() and paths.SHIPPED_RECORDING.is_dir()):
        pytest.skip("the shipped weights and recording are not there")
    return Shipped()
