"""Windows of the reference rig's frames, from shards of toys."""

import numpy as np

from lib.training.samples import Samples
from lib.training.shards import validation_images
from notebooks.studies.windows import WindowSource


def test_shards_hold_what_the_stages_see(tmp_path, toy_shards):
    """Large toys instead of the simulator: crops carry the landmarks of the full frame."""
    images = toy_shards(tmp_path, 2)
    windows = WindowSource.load(tmp_path)
    assert len(windows) == 6
    rng = np.random.default_rng(0)
    for index in range(6):
        image, u, _ = windows.draw(index, rng)
        assert image.shape == (128, 128, 3)
        k = windows.landmark[index]
        assert np.linalg.norm(u[k] - 63.5) < 60
        assert u[1:, 0].mean() > u[0, 0]  # the tool points right
        assert u[1, 1] < u[2, 1]  # and tip_1 is above
    tools = WindowSource.load_tools(tmp_path)
    assert len(tools) == 2
    assert len(Samples.drawn(windows)) == 6
    _, image, u, *_ = next(iter(validation_images(tmp_path, "validation")))
    assert image.shape == (540, 960, 3)
    assert np.allclose(u, images[0].u)
