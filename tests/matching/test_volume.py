"""The displacement volume: correlations against direct products, matches against known motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lib.matching.band import refine
from lib.matching.deepmatching import correlation_volume, match_volume, peak_ratio


@pytest.fixture(scope="module")
def grids():
    rng = np.random.default_rng(0)
    gy, gx, low, n, v = 9, 11, -5, 17, 2
    left = rng.random((4 * gy, 4 * gx, 9)).astype(np.float32)
    right = rng.random((4 * gy + 2 * v, 4 * gx + n - 1, 9)).astype(np.float32)
    return left, right, low, n, v


def test_correlations_are_cosines_of_patches(grids):
    left, right, _, n, v = grids
    right = right.copy()
    right[:6, :9] = 0.0  # masked
    volume = correlation_volume(torch.from_numpy(left), torch.from_numpy(right), v).numpy()
    assert volume.shape == (9, 11, 2 * v + 1, n)
    for y, x, j, k in [(0, 0, 0, 0), (3, 5, 2, 5), (8, 10, 4, 16), (0, 10, 1, 3), (8, 0, 3, 9), (0, 1, 1, 6)]:
        patch = left[4 * y : 4 * y + 4, 4 * x : 4 * x + 4].ravel()
        window = right[4 * y + j : 4 * y + j + 4, 4 * x + k : 4 * x + k + 4].ravel()
        expected = patch @ window / max(np.linalg.norm(patch) * np.linalg.norm(window), 1e-12)
        assert volume[y, x, j, k] == pytest.approx(expected, abs=1e-5)


def test_every_size_of_volume_works_and_finds_the_motion():
    rng = np.random.default_rng(1)
    for gy, gx, low, n, v in [
        (1, 1, 0, 1, 0),
        (2, 9, -3, 8, 1),
        (9, 2, -3, 7, 0),
        (16, 17, -4, 9, 3),
        (5, 33, -7, 20, 2),
    ]:
        left = rng.random((4 * gy, 4 * gx, 9)).astype(np.float32)
        right = rng.random((4 * gy + 2 * v, 4 * gx + n - 1, 9)).astype(np.float32)
        shift, drop = n // 2, v  # on the line
        right[drop : drop + 4 * gy, shift : shift + 4 * gx] = left
        found = match_volume(correlation_volume(torch.from_numpy(left), torch.from_numpy(right), v), low)
        assert len(found.patch) == gy * gx
        assert (found.cell == (low + shift, 0)).all()


def test_matches_are_one_to_one(grids):
    left, right, low, _, v = grids
    found = match_volume(correlation_volume(*map(torch.from_numpy, (left, right)), v), low)
    assert 0 < len(found.patch) < 99
    bins = (found.patch * 4 + 2 + found.cell) // 4
    assert len(np.unique(bins, axis=0)) == len(bins)
    assert np.abs(found.displacement - found.cell).max() <= 0.5
    kept = found.keep(found.peaked)
    assert len(kept.patch) == kept.peaked.sum() < len(found.patch)


@pytest.mark.parametrize("margin", [0, 1])
def test_refinement_recovers_fractions_of_a_cell(margin):
    y, x = np.mgrid[:48, :64].astype(np.float32)

    def field(dx: float, dy: float) -> np.ndarray:
        a, b = x - dx, y - dy
        waves = [np.sin(0.5 * a + 0.3 * b + k) + np.cos(0.35 * a - 0.45 * b + 2 * k) for k in range(9)]
        return (2 + np.stack(waves, axis=2)).astype(np.float32)

    start = np.stack(np.meshgrid(np.arange(8, 52, 4), np.arange(8, 36, 4)), axis=-1).reshape(-1, 2)
    for dx, dy in [(0.0, 0.0), (0.3, 0.0), (-0.45, 0.0), (0.2, 0.15)]:
        step, sigma = refine(field(0, 0), field(dx, dy), start, start, margin=margin)
        tolerance = 1e-6 if dx == dy == 0 else 0.03
        assert np.median(np.abs(step[:, 1] - dy)) < max(tolerance, 0.05 * abs(dy) + 0.02 * (dy != 0))
        if dy == 0:  # x is told for a match on the line
            assert np.abs(step[:, 0] - dx).max() < tolerance
        assert (sigma >= 0).all()


def test_refinement_ignores_gain_and_works_at_the_border():
    rng = np.random.default_rng(4)
    grid = rng.random((16, 20, 9)).astype(np.float32)
    corners = np.array([[0, 0], [16, 0], [0, 12], [16, 12]])
    step, _ = refine(grid, 0.5 * grid, corners, corners, margin=1)
    assert np.abs(step).max() < 1e-5


def test_peak_ratio_compares_the_match_with_the_best_place_elsewhere():
    maps = torch.zeros(4, 1, 8)
    maps[:2, 0, [2, 3, 6]] = torch.tensor([0.8, 0.9, 0.6])
    maps[2, 0, [0, 2]] = torch.tensor([0.4, 0.8])
    maps[3, 0, 7] = 0.5  # nothing else responds
    ratio = peak_ratio(maps.clone(), torch.zeros(4, dtype=int), torch.tensor([3, 6, 0, 7]))
    assert ratio == pytest.approx([1.5, 2 / 3, 0.5, np.inf], rel=1e-6)
    assert np.isnan(peak_ratio(maps[:1, :, :3], *torch.tensor([[0], [1]]))).all()
    square = torch.zeros(1, 5, 5)
    square[0, [1, 2, 4], [1, 2, 0]] = torch.tensor([0.9, 0.5, 0.3])
    assert peak_ratio(square, *torch.tensor([[1], [1]])) == pytest.approx([3.0])
    assert peak_ratio(torch.zeros(0, 3, 8), *torch.zeros((2, 0), dtype=int)).shape == (0,)


def test_only_the_best_of_two_patches_on_one_place_is_reciprocal():
    rng = np.random.default_rng(3)
    left, right = rng.random((4, 16, 9)).astype(np.float32), rng.random((4, 20, 9)).astype(np.float32)
    left[:, 4:8] = 0.9 * left[:, :4] + 0.1 * left[:, 4:8]  # a worse copy of the first patch
    right[:, 4:8], right[:, 12:20] = left[:, :4], left[:, 8:]
    volume = correlation_volume(torch.from_numpy(left), torch.from_numpy(right), 0)
    every = match_volume(volume, 0, reciprocal=False)
    assert every.patch[:, 0].tolist() == [0, 1, 2, 3] and every.cell[:, 0].tolist() == [4, 0, 4, 4]
    assert every.reciprocal.tolist() == [True, False, True, True]
    only = match_volume(volume, 0)
    assert only.reciprocal.all() and only.patch[:, 0].tolist() == [0, 2, 3]
