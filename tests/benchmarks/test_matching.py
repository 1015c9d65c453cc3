"""Seconds of the matchers: `python3 -m lib bench`, or pytest on this folder."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lib.geometry import RigidTransform
from lib.matching import RECTIFIED, glint_mask, match
from lib.simulator.rig import IMAGE_SIZE_PX, reference_rig
from notebooks import real_data
from notebooks.studies import surface_evaluation as evaluation


def full_hd_pair():
    """Two views of a textured, tilted plane with the reference rig: the work of a real pair, known to fit."""
    rng = np.random.default_rng(0)
    rig = reference_rig(robot_from_microscope=RigidTransform.identity())
    texture = sum(
        a * cv2.resize(rng.standard_normal((n, n)).astype(np.float32), (2400, 2400), interpolation=cv2.INTER_CUBIC)
        for a, n in ((12, 600), (15, 200), (20, 40))
    )
    texture = np.clip(130 + texture, 0, 240).astype(np.uint8)
    tilt, images = np.array([0.08, 0.05]), []  # z = tilt.(x, y), mm
    for camera in (rig.left, rig.right):
        linear = camera.linear[:, :2] + np.outer(camera.linear[:, 2], tilt)
        plane_to_texture = np.array([[100.0, 0, 1200], [0, 100, 1200]])
        inverse = np.linalg.inv(linear)
        texture_from_image = np.column_stack(
            [
                plane_to_texture[:, :2] @ inverse,
                plane_to_texture[:, 2] - plane_to_texture[:, :2] @ inverse @ camera.offset_px,
            ]
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        images.append(cv2.warpAffine(texture, texture_from_image, IMAGE_SIZE_PX, flags=flags))
    return [np.repeat(image[:, :, None], 3, axis=2) for image in images], rig


@pytest.fixture(scope="module")
def full_hd():
    return full_hd_pair()


@pytest.mark.benchmark(group="full-HD affine pair")
@pytest.mark.parametrize("setting", ["fast", "quality"])
@pytest.mark.parametrize("method", ["band", "sgbm", "dis"])
def test_full_hd(benchmark, full_hd, method, setting):
    (left, right), rig = full_hd
    masks = {"mask_left": glint_mask(left), "mask_right": glint_mask(right)}
    matches = benchmark.pedantic(
        match, (left, right), {"rig": rig, "method": method, "setting": setting} | masks, rounds=5, warmup_rounds=1
    )
    assert len(matches) > 5000


@pytest.mark.benchmark(group="motorcycle")
@pytest.mark.parametrize("width_px", [512, 1024])
@pytest.mark.parametrize("method", ["band", "sgbm", "dis", "deepmatching"])
def test_motorcycle(benchmark, method, width_px):
    """The study `matching` scores the same matches."""
    folder = real_data.folder("stereo_pairs")
    if folder is None:
        pytest.skip(real_data.missing_line("stereo_pairs"))
    free = method == "deepmatching"
    if free and width_px > 512:
        pytest.skip("free DeepMatching grows with the fourth power of the width")
    pair = evaluation.real_pair(folder / "motorcycle").left_part(width_px, width_px * 3 // 4)
    options = {"method": method} | ({} if free else {"rig": RECTIFIED})
    matches = benchmark.pedantic(match, (pair.left, pair.right), options, rounds=1 if free else 5)
    assert len(matches) > 2000
