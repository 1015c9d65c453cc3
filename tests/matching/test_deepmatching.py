"""Free DeepMatching: against a slow implementation, on known motion, in tiles, and its memory."""

from __future__ import annotations

import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from lib.matching import match
from lib.matching.deepmatching import POWER, gather, n_levels, path_scores, pool, unpool
from lib.matching.descriptors import pixel_descriptors
from lib.paths import ROOT
from notebooks.figures.reconstruction import atomic_maps, response_map


def slow_scores(left: np.ndarray, right: np.ndarray, levels: int) -> dict[tuple[int, int, int, int], float]:
    """Best path score to every (gy, gx, y, x) cell of the atomic maps: loops and recursion, straight from the paper."""
    gy, gx = left.shape[0] // 4, left.shape[1] // 4
    height, width = right.shape[0] + 1, right.shape[1] + 1
    padded = np.pad(right, ((2, 2), (2, 2), (0, 0)))
    inside = np.pad(np.ones(right.shape[:2]), 2)
    maps = [{}]
    for i in range(gy):
        for j in range(gx):
            patch = left[4 * i : 4 * i + 4, 4 * j : 4 * j + 4]
            response = np.zeros((height, width))
            for y in range(height):
                for x in range(width):
                    window, seen = padded[y : y + 4, x : x + 4], inside[y : y + 4, x : x + 4, None]
                    norms = np.linalg.norm(window) * np.linalg.norm(patch * seen)
                    response[y, x] = (window * patch).sum() / max(norms, 1e-12)
            maps[0][i, j] = response**1.4

    def pool(response):
        height, width = response.shape
        return np.array(
            [
                [response[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].max() for x in range(0, width, 2)]
                for y in range(0, height, 2)
            ]
        )

    def children(level, i, j):
        gap = 2 ** (level - 2) if level >= 2 else 0
        for side_y in (-1, 1):
            for side_x in (-1, 1):
                if level == 1:
                    child = i + (side_y - 1) // 2, j + (side_x - 1) // 2
                else:
                    child = i + side_y * gap, j + side_x * gap
                if child in maps[level - 1]:
                    yield child, side_y, side_x

    for level in range(1, levels + 1):
        pooled = {key: pool(response) for key, response in maps[-1].items()}
        height, width = next(iter(pooled.values())).shape
        maps.append({})
        for i in range(gy + 1):
            for j in range(gx + 1):
                total, exist, valid = np.zeros((height, width)), 0, np.zeros((height, width))
                for child, side_y, side_x in children(level, i, j):
                    exist += 1
                    for y in range(height):
                        for x in range(width):
                            if 0 <= y + side_y < height and 0 <= x + side_x < width:
                                total[y, x] += pooled[child][y + side_y, x + side_x]
                                valid[y, x] += 1
                if exist:
                    scale = np.where(valid > 0, (exist / np.maximum(valid, 1)) ** 0.9 / exist, 0.0)
                    maps[level][i, j] = (total * scale) ** 1.4

    best: dict[tuple, float] = {}

    def descend(level, i, j, y, x, score):
        score += maps[level][i, j][y, x]
        if score <= best.get((level, i, j, y, x), -np.inf):
            return
        best[level, i, j, y, x] = score
        if level == 0:
            return
        for child, side_y, side_x in children(level, i, j):
            response = maps[level - 1][child]
            cy, cx = 2 * (y + side_y), 2 * (x + side_x)
            if 0 <= cy < response.shape[0] and 0 <= cx < response.shape[1]:
                around = [
                    (response[v, u], v, u)
                    for v in range(max(cy - 1, 0), min(cy + 2, response.shape[0]))
                    for u in range(max(cx - 1, 0), min(cx + 2, response.shape[1]))
                ]
                _, v, u = max(around)
                descend(level - 1, *child, v, u, score)

    for (i, j), response in maps[levels].items():
        for y, x in np.ndindex(response.shape):
            descend(levels, i, j, y, x, 0.0)
    return {key[1:]: score for key, score in best.items() if key[0] == 0}


def test_whole_map_passes_equal_the_recursion_they_replace():
    rng = np.random.default_rng(5)
    left, right = rng.random((16, 16, 9)).astype(np.float32), rng.random((20, 16, 9)).astype(np.float32)
    right[2:18] += 2 * left  # something to find
    slow = slow_scores(left.astype(float), right.astype(float), levels=2)
    maps = atomic_maps(torch.from_numpy(left), torch.from_numpy(right)) ** POWER
    assert n_levels(4, 4) == 2
    score = unpool(maps, path_scores(pool(maps), n_levels(4, 4), shifted=True)).numpy()
    fast = {tuple(key): score[tuple(key)] for key in np.argwhere(np.isfinite(score)).tolist()}
    assert fast.keys() == slow.keys()
    assert max(abs(fast[key] - slow[key]) for key in slow) < 1e-4


def test_matches_are_one_to_one_and_follow_a_translation(textured):
    right = np.roll(textured, (6, -10), axis=(0, 1))
    matches = match(textured, right)
    assert matches.method == "deepmatching"
    motion = matches.u_right - matches.u_left
    inner = (matches.u_left[:, 0] > 24) & (matches.u_left[:, 1] < 108)
    assert np.mean((motion[inner] == (-10, 6)).all(axis=1)) > 0.95
    assert len(np.unique(matches.u_left, axis=0)) == len(matches)
    bins = np.floor((matches.u_right + 0.5) / 8)
    assert len(np.unique(bins, axis=0)) == len(matches)


def test_positions_have_no_half_pixel_bias(textured):
    """Mirroring both images mirrors the matches: centres are counted the same from either side."""
    right = np.roll(textured, -6, axis=1)
    there = match(textured, right)
    mirrored = match(textured[:, ::-1], right[:, ::-1])
    back = mirrored.u_left * (-1, 1) + (textured.shape[1] - 1, 0)
    motion = (mirrored.u_right - mirrored.u_left) * (-1, 1)
    at = {tuple(u): m for u, m in zip(there.u_left, there.u_right - there.u_left, strict=True)}
    same = [np.array_equal(at[tuple(u)], m) for u, m in zip(back, motion, strict=True) if tuple(u) in at]
    assert len(same) > 0.8 * len(there)
    assert np.mean(same) > 0.95


def test_scale_change_and_rotation_are_followed():
    rng = np.random.default_rng(2)
    noise = cv2.GaussianBlur(rng.standard_normal((192, 256)).astype(np.float32), (0, 0), 2)
    left = np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    affine = cv2.getRotationMatrix2D((127.5, 95.5), 6, 1.06)
    right = cv2.warpAffine(left, affine, (256, 192), borderMode=cv2.BORDER_REFLECT)
    matches = match(left, right)
    expected = matches.u_left @ affine[:, :2].T + affine[:, 2]
    error = np.linalg.norm(matches.u_right - expected, axis=1)
    assert len(matches) > 400
    assert np.median(error) < 1.5


def test_downscale_adapts_to_the_budget(textured):
    free = match(textured, textured, budget_bytes=1 << 30)
    tight = match(textured, textured, budget_bytes=5 << 20)
    assert len(tight) < len(free) / 2
    assert np.array_equal(tight.u_left, tight.u_right)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the peak from /proc")
def test_memory_is_predicted():
    """Peak resident memory of a fresh process against the prediction."""
    program = (
        "import numpy as np\n"
        "from lib.matching import match\n"
        "from lib.matching.deepmatching import predicted_bytes\n"
        "def peak():\n"
        "    return int(open('/proc/self/status').read().split('VmHWM:')[1].split()[0]) * 1024\n"
        "image = np.random.default_rng(0).integers(0, 255, (160, 192), dtype=np.uint8)\n"
        "match(image[:64, :64], image[:64, :64])\n"
        "before = peak()\n"
        "match(image, image, downscale=1)\n"
        "print((peak() - before) / predicted_bytes(image.shape, image.shape, downscale=1))\n"
    )
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=environment, capture_output=True, check=True)
    ratio = float(run.stdout)
    assert 0.5 < ratio < 1.15


def test_responses_grow_sure(textured):
    """The larger the patch, the fewer places come close to the best one (what notebook 04 shows)."""
    grids = [torch.from_numpy(pixel_descriptors(i, 1)) for i in (textured, np.roll(textured, -20, axis=1))]
    responses = [atomic_maps(*grids) ** POWER]
    for level in (1, 2):
        pooled = pool(responses[-1])
        responses.append(gather(gather(pooled, 0, level, shifted=True), 1, level, shifted=True) ** POWER)
    maps = [response_map(response, level, np.array([100.0, 60.0])) for level, response in enumerate(responses)]
    assert [m.size_px for m in maps] == [8, 16, 32]
    for m, level in zip(maps, range(3), strict=True):
        assert m.response.min() >= 0 and m.response.max() <= 1 + 1e-5
        assert np.abs(m.centre_px - (100, 60)).max() <= 4.5
        assert np.abs(m.peak_px - m.centre_px - (-20, 0)).max() <= 2 ** (level + 1)
    near = [np.mean(m.response > 0.9 * m.response.max()) * m.response.size for m in maps]
    assert near[2] < near[0]


@pytest.mark.cuda
def test_cuda_gives_the_same_matches(textured):
    right = np.roll(textured, -10, axis=1)
    on_cpu, on_gpu = match(textured, right), match(textured, right, device="cuda")
    assert np.array_equal(on_cpu.u_left, on_gpu.u_left) and np.array_equal(on_cpu.u_right, on_gpu.u_right)
