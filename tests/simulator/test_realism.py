"""Image statistics and distributions, the preset of the in-vivo frames, and what is said of exceptions."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from notebooks.figures.data import verdict_page
from notebooks.studies.realism import (
    LIGHTS,
    STATISTICS,
    compare,
    exceptions,
    fundus_windows,
    in_vivo_window,
    profiles,
    real_windows,
    statistics_table,
)


@pytest.fixture(scope="module")
def windows():
    rng = np.random.default_rng(3)
    return {lamp: [in_vivo_window(rng, 64, lamp) for _ in range(3)] for lamp in LIGHTS}


def test_the_preset_has_the_colours_of_its_lamps(windows):
    for lamp, drawn in windows.items():
        for image, u in drawn:
            assert image.shape == (64, 64, 3) and image.dtype == np.uint8 and u.shape == (3, 2)
            assert ((u > 0) & (u < 63)).all(axis=1).any()  # the tool is in the window
        table = statistics_table([image for image, _ in drawn])
        assert_allclose(np.median(table["blue_over_green"]), LIGHTS[lamp].colour[2], rtol=0.2)
    with pytest.raises(ValueError, match="seq1, seq2"):
        in_vivo_window(np.random.default_rng(0), light="ultraviolet")


def test_comparison_finds_and_explains_what_lies_outside():
    real = {name: np.linspace(1.0, 2.0, 21) for name in STATISTICS}
    simulated = {name: np.full(5, 1.5) for name in STATISTICS}
    assert exceptions(compare(real, simulated)) == []
    simulated["saturated_share"] = np.full(5, 0.9)
    simulated["sharpness_centre"] = np.full(5, 2.1)
    rows = compare(real, simulated)
    assert [r["name"] for r in rows if not r["within"]] == ["saturated_share", "sharpness_centre"]
    low, high = exceptions(rows)
    assert "0.9, below the real 5th percentile 1.05" in low and "2.1, above the real 95th percentile 1.95" in high
    page = verdict_page({"one": rows, "two": rows})
    assert len(page.axes[0].lines) == 2


def test_distributions_of_known_images():
    rng = np.random.default_rng(0)
    noise = np.repeat(rng.normal(128, 12, (96, 96, 1)).clip(0, 255).astype(np.uint8), 3, axis=2)
    found = profiles([noise, noise])
    assert_allclose(found.luminance.sum(axis=1), 1, atol=1e-6)
    assert_allclose(found.colour.sum(axis=2), 1, atol=1e-6)
    assert_allclose((found.gradient * np.diff(found.slope)[0]).sum(axis=1), 1, atol=0.01)
    assert_allclose((found.luminance[0] * found.level).sum(), 128 / 255, atol=0.01)
    # A difference of two pixels has sqrt(2) times their noise; white noise has a flat spectrum.
    variance = (found.gradient[0] * found.slope**2).sum() * np.diff(found.slope)[0]
    assert_allclose(np.sqrt(variance), np.sqrt(2) * 12 / 255, rtol=0.1)
    assert np.ptp(np.log(found.power[0][4:])) < 1.0


def test_fundus_windows_leave_out_the_black_surround(tmp_path):
    photograph = np.zeros((400, 400, 3), np.uint8)
    cv2.circle(photograph, (200, 200), 199, (40, 80, 160), -1)
    cv2.imwrite(str(tmp_path / "fundus.png"), photograph)
    real, simulated = fundus_windows(tmp_path / "fundus.png", seeds=[40], n=6, size_px=96)
    assert len(real) == len(simulated) == 6
    assert all(window.shape == (96, 96, 3) and window.min() > 20 for window in real)
    assert all(window.shape == (96, 96, 3) and window.std() > 3 for window in simulated)
    with pytest.raises(ValueError, match="size_px: a window of 400 px does not fit; at most 339"):
        fundus_windows(tmp_path / "fundus.png", seeds=[40], n=1, size_px=400)
    cv2.imwrite(str(tmp_path / "wide.png"), photograph[50:350])
    with pytest.raises(ValueError, match=r"wide\.png: 400 x 300 px, expected a square; crop it"):
        fundus_windows(tmp_path / "wide.png", seeds=[40], n=1)


def test_frames_that_tune_and_frames_that_judge_are_different(tmp_path):
    names = "frame,shaft_x,shaft_y,base_x,base_y,tip_1_x,tip_1_y,tip_2_x,tip_2_y"
    for sequence in ("seq1", "seq2"):
        (tmp_path / sequence).mkdir()
        lines = [names]
        for k in range(6):
            cv2.imwrite(str(tmp_path / sequence / f"{k:06d}.jpg"), np.full((120, 160, 3), 40 * k, np.uint8))
            lines.append(f"{k},10,10,70,60,80,60,80,70")
        (tmp_path / sequence / "landmarks.csv").write_text("\n".join(lines) + "\n")
    levels = {
        part: sorted({int(w.mean()) for ws in real_windows(tmp_path, 6, 48, part).values() for w in ws})
        for part in ("tuned", "judged")
    }
    assert max(levels["tuned"]) < min(levels["judged"])
    with pytest.raises(ValueError, match="part"):
        real_windows(tmp_path, 6, part="all")
