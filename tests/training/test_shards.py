"""Shards hold what the stages see; the simulator is replaced by a stand-in."""

from dataclasses import replace

import numpy as np
import pytest

from lib.training import shards
from lib.training.samples import LabelledImage
from lib.training.sources import CloseupSource, FrameSource, ToolSource


def test_where_a_landmark_lies_in_its_jpeg_blocks_does_not_tell_its_place(monkeypatch, tmp_path):
    """A stand-in for the simulator that asks where the landmark will lie in the image that is compressed."""
    places = []

    def sample(rng, *, crop_px, around, jitter, textures, population, photographs):
        u = (crop_px - 1) / 2 - np.round(rng.uniform(-jitter, jitter, (3, 2)) * crop_px)
        places.append(u[around])
        return np.zeros((crop_px, crop_px, 3), np.uint8), u, np.full(3, 2)

    monkeypatch.setattr(shards, "sample", sample)
    monkeypatch.setattr(shards, "CLOSEUP_CROP_PX", 128)
    monkeypatch.setattr(shards, "CLOSEUPS", 400)
    shards.make_shard(tmp_path / "closeups_0000.npz", "closeups", 0)
    inside = np.array(places).ravel() % shards.BLOCK_PX
    assert len(np.unique(inside)) == shards.BLOCK_PX
    with np.load(tmp_path / "closeups_0000.npz") as shard:
        own = shard["crop_u"][np.arange(400), shard["crop_landmark"]]
    assert np.abs(own - 63.5).max() <= 0.5


def test_a_small_tool_in_a_large_frame_is_stored_as_large_as_its_window_shows_it():
    u = np.array([[900.0, 500.0], [990.0, 510.0], [990.0, 490.0]])
    frame = LabelledImage("small", np.zeros((1080, 1920, 3), np.uint8), u, np.full(3, 2))
    image, at, *_ = ToolSource.of([frame]).frame(0)
    assert 55 < np.linalg.norm(at[1:].mean(axis=0) - at[0]) < 62 and 1200 < image.shape[1] < 1300
    assert FrameSource.of([frame]).frame(0)[0].shape[1] == shards.SCENE_PX  # the first stage shrinks all


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
    source = replace(CloseupSource.load(tmp_path), disguise=0.0, drawn=0.0)
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


def test_proposals_are_found_once_and_missing_ones_are_nan(monkeypatch, tmp_path):
    class Proposing:
        """Sees two tools in every image, the second one better."""

        def proposed(self, image):
            u = np.stack([np.full((3, 2), 1.0), np.full((3, 2), 2.0)])
            return u, u, np.array([0.1, 0.9])

    monkeypatch.setattr(shards.Detector, "load", lambda name: Proposing())
    image = LabelledImage("a", np.full((90, 160, 3), 90, np.uint8), np.full((3, 2), 40.0), np.full(3, 2))
    assert shards.read_proposals(tmp_path) is None
    for kind in ("scenes", "proposals", "held_out"):  # of a killed process
        (tmp_path / f"{kind}_0001.4711.partial.npz").write_bytes(b"half")
    for number in range(2):
        ends, jpegs, u, visibility = shards.packed([image] * 3)
        np.savez(tmp_path / f"scenes_{number:04d}.npz", jpegs=jpegs, jpeg_ends=ends, u=u, visibility=visibility)
    assert len(shards.read_scenes(tmp_path)[0]) == 6 and list(shards.validation_images(tmp_path)) == []
    shards.make_proposals(tmp_path / "proposals_0001.npz", tmp_path / "scenes_0001.npz", None)
    found = shards.read_proposals(tmp_path)
    assert found.shape == (6, shards.PROPOSALS, 3, 2) and np.isnan(found[:3]).all()
    np.savez(tmp_path / "proposals_0000.npz", u=found[:2])
    with pytest.raises(ValueError, match=r"proposals_0000.npz: made for other scenes"):
        shards.read_proposals(tmp_path)
    assert (found[3:, 0] == 2).all() and (found[3:, 1] == 1).all() and np.isnan(found[3:, 2:]).all()


def test_missing_and_corrupt_shards_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no shard closeups"):
        CloseupSource.load(tmp_path)
    np.savez(tmp_path / "whole.npz", **{name: np.zeros((2, 40, 60, 3), np.uint8) for name in ("crops", "jpegs")})
    whole = (tmp_path / "whole.npz").read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 4] ^= 1
    for content in (b"not an archive", b"", whole, whole[: len(whole) // 2], bytes(flipped)):
        for name in ("closeups_0000.npz", "held_out_0000.npz"):
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"closeups_0000\.npz: corrupt"):
            CloseupSource.load(tmp_path)
        with pytest.raises(ValueError, match=r"held_out_0000\.npz: corrupt"):
            list(shards.validation_images(tmp_path))
