"""Shards hold what the stages see; the simulator is replaced by the toy renderer where it would be slow."""

from dataclasses import replace

import numpy as np
import pytest

from lib.training import shards
from lib.training.samples import Samples
from lib.training.windows import CloseupSource, WindowSource


def test_shards_hold_what_the_stages_see(tmp_path, toy_shards):
    """Large toys instead of the simulator: crops and reduced frames carry the landmarks of the full frame."""
    images = toy_shards(tmp_path, 2)
    standing = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    shards.generate(tmp_path, "training", 1, progress=False)  # stands already: nothing is drawn
    shards.generate(tmp_path, "validation", 1, progress=False)
    assert standing == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    frames = shards.frame_samples(tmp_path)
    assert np.allclose(8 * frames.u + 3.5, [image.u for image in images])
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
    _, image, u, _ = next(iter(shards.validation_images(tmp_path, "validation")))
    assert image.shape == (540, 960, 3)
    assert np.allclose(u, images[0].u)


def test_shards_of_windows_alone_are_centred_on_their_landmark(tmp_path, toy_shards, monkeypatch):
    """A stand-in for the simulator, whose landmark lies off the centre where the field ends, and is now and then unseen."""

    def off_centre(rng, *, crop_px, around, jitter, textures, population):
        image, u = np.zeros((crop_px, crop_px, 3), np.uint8), rng.uniform(60, 200, (3, 2))
        x, y = np.round(u[around]).astype(int)
        image[y, x] = 255
        return image, u, np.where(np.arange(3) == around, rng.integers(0, 3), 2)

    monkeypatch.setattr(shards, "sample", off_centre)
    monkeypatch.setitem(shards.CROPS, "windows", (shards.CROP_PX, 5))
    for index in range(2):
        shards.make_shard(tmp_path / f"windows_{index:04d}.npz", "windows", index)
    shards.generate(tmp_path, "windows", 2, progress=False)  # they stand already: nothing is drawn
    with np.load(tmp_path / "windows_0001.npz") as shard:
        for crop, u, visibility, k in zip(
            *(shard[name] for name in ("crops", "crop_u", "crop_visibility", "crop_landmark")), strict=True
        ):
            assert np.abs(u[k] - (shards.CROP_PX - 1) / 2).max() <= 0.5
            assert visibility[k] > 0
            assert np.abs(np.argwhere(crop[..., 0])[0][::-1] - u[k]).max() <= 0.5
    toy_shards(tmp_path, 2)
    both = WindowSource.load(tmp_path)
    assert len(both) == 2 * 3 + 2 * 5
    assert len(WindowSource.load(tmp_path, shards=1)) == 6  # frames alone
    first = np.load(tmp_path / "training_0000.npz")["crops"]
    assert np.array_equal(both.crops[: len(first)], first)


def test_where_a_landmark_lies_in_its_jpeg_blocks_does_not_tell_its_place(monkeypatch, tmp_path):
    """A stand-in for the simulator that asks where the landmark will lie in the image that is compressed."""
    places = []

    def sample(rng, *, crop_px, around, jitter, textures, population):
        u = (crop_px - 1) / 2 - np.round(rng.uniform(-jitter, jitter, (3, 2)) * crop_px)
        places.append(u[around])
        return np.zeros((crop_px, crop_px, 3), np.uint8), u, np.full(3, 2)

    monkeypatch.setattr(shards, "sample", sample)
    monkeypatch.setitem(shards.CROPS, "closeups", (128, 400))
    shards.make_shard(tmp_path / "closeups_0000.npz", "closeups", 0)
    inside = np.array(places).ravel() % shards.BLOCK_PX
    assert len(np.unique(inside)) == shards.BLOCK_PX
    with np.load(tmp_path / "closeups_0000.npz") as shard:
        own = shard["crop_u"][np.arange(400), shard["crop_landmark"]]
    assert np.abs(own - 63.5).max() <= 0.5


def test_closeups_are_stretched_with_their_landmark(tmp_path):
    """A dot at the landmark lies where the label says, in every closeup; its own landmark alone is visible."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:128, :128]
    crops, u, landmark = [], [], np.arange(30) % 3
    for k in landmark:
        points = rng.uniform(-30, 30, (3, 2)) + 64
        points[k] = rng.uniform(63, 64, 2)
        dot = 255 * np.exp(-((columns - points[k, 0]) ** 2 + (rows - points[k, 1]) ** 2) / 8)
        crops.append(np.repeat(dot[..., None], 3, 2).round().astype(np.uint8))
        u.append(points)
    arrays = {"crops": np.stack(crops), "crop_u": np.stack(u), "crop_landmark": landmark}
    visibility = np.full((30, 3), 2)
    visibility[4, 1] = 1  # hidden: not trained on
    np.savez(tmp_path / "closeups_0000.npz", crop_visibility=visibility, **arrays)
    source = replace(CloseupSource.load(tmp_path), disguise=0.0)
    assert len(source) == 29
    for i in range(len(source)):
        image, at, seen = source.draw(i, rng)
        k = source.landmark[i]
        assert image.shape == (64, 64, 3)
        assert seen.tolist() == [2 * (j == k) for j in range(3)]
        y, x = np.mgrid[:64, :64]
        mass = image[..., 0].astype(float)
        if (np.abs(at[k] - 31.5) < 18).all():
            found = np.array([(x * mass).sum(), (y * mass).sum()]) / mass.sum()
            assert np.abs(found - at[k]).max() < 0.15
    for change in (
        {"u": source.u + 1},
        {"stretch": 0.3},
        {"shifts_px": (1.0, 2.0, 3.0)},
        {"landmark": 2 - source.landmark},
    ):
        assert source.fingerprint != replace(source, **change).fingerprint


def test_missing_and_corrupt_shards_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no shard training"):
        shards.frame_samples(tmp_path)
    np.savez(tmp_path / "whole.npz", **{name: np.zeros((2, 40, 60, 3), np.uint8) for name in ("frames", "jpegs")})
    whole = (tmp_path / "whole.npz").read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 4] ^= 1
    for content in (b"not an archive", b"", whole, whole[: len(whole) // 2], bytes(flipped)):
        for name in ("training_0000.npz", "validation_0000.npz"):
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"training_0000\.npz: corrupt"):
            shards.frame_samples(tmp_path)
        with pytest.raises(ValueError, match=r"validation_0000\.npz: corrupt"):
            list(shards.validation_images(tmp_path, "validation"))
