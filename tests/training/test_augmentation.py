"""Image and landmarks must move together: a Gaussian drawn at the landmark is found again at the moved landmark."""

import kornia.augmentation as K
import numpy as np
import pytest
import torch

from lib.landmarks.heatmaps import decode, render
from lib.training.augmentation import AUGMENTATIONS, Augmentation, Batch, leave_frame


def gaussians(n=4, size=(160, 200), seed=0, low=0.35, high=0.65):
    """Images whose three channels hold a Gaussian at the three landmarks."""
    rng = np.random.default_rng(seed)
    u = torch.from_numpy(rng.uniform(low, high, (n, 3, 2)) * np.array(size)[::-1])
    return Batch(render(u, size, 1, 4.0).float(), u, torch.full((n, 3), 2))


GEOMETRIC = {
    "paper": AUGMENTATIONS["paper"],
    "rotation": Augmentation(180.0, (1.0, 1.0)),
    "zoom": Augmentation(0.0, (0.75, 1.25)),
}


@pytest.mark.parametrize("name", GEOMETRIC)
def test_landmarks_move_with_the_image(name):
    batch = gaussians()
    for seed in range(3):
        moved = GEOMETRIC[name](batch, np.random.default_rng(seed))
        assert (moved.u - batch.u).norm(dim=-1).max() > 0.5
        found = decode(moved.images, 1, sigma_px=4.0).u
        seen = moved.visibility == 2
        assert seen.any()
        assert (found - moved.u).norm(dim=-1)[seen].max() < 0.01


def test_landmarks_on_the_border_stay_exact_or_become_absent():
    u = torch.tensor([[[0.0, 0.0], [199.0, 80.0], [100.0, 159.0]]], dtype=torch.float64)
    batch = Batch(render(u, (160, 200), 1, 4.0).float(), u, torch.full((1, 3), 2))
    inside = 0
    for seed in range(8):
        moved = Augmentation(30.0, (0.75, 1.0))(batch, np.random.default_rng(seed))
        within = ((moved.u >= -0.5) & (moved.u < torch.tensor([199.5, 159.5]))).all(-1)
        assert torch.equal(moved.visibility == 2, within)
        # Near the border the image is cut, so measure the label against the transform of a point inside.
        inside += int(within.sum())
    assert inside > 0


def test_border_points_obey_the_same_map_as_inner_ones():
    u = torch.tensor([[[0.0, 0.0], [150.0, 110.0], [50.0, 50.0]]], dtype=torch.float64)
    batch = Batch(render(u, (160, 200), 1, 4.0).float(), u, torch.full((1, 3), 2))
    moved = AUGMENTATIONS["paper"](batch, np.random.default_rng(3))
    found = decode(moved.images, 1, sigma_px=4.0).u.double()
    # A similarity is fixed by two points: predict the border point from the two that were measured.
    z = torch.view_as_complex(found[0].contiguous())
    w = torch.view_as_complex(u[0].contiguous())
    predicted = z[1] + (z[2] - z[1]) / (w[2] - w[1]) * (w[0] - w[1])
    assert abs(predicted - torch.view_as_complex(moved.u[0].contiguous())[0]) < 0.01


def test_missing_landmarks_stay_missing_and_are_masked():
    batch = gaussians(2)
    u = batch.u.clone()
    u[0, 1] = torch.nan
    for augmentation in AUGMENTATIONS.values():
        moved = augmentation(Batch(batch.images, u, batch.visibility), np.random.default_rng(0))
        missing = torch.isnan(moved.u).any(-1)
        assert missing.sum() == 1
        assert missing[0].any()
        assert moved.weight[missing].max() == 0
        assert moved.weight.sum() == 5


def test_absence_is_trained_and_occlusion_has_half_a_peak():
    batch = Batch(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 2), torch.tensor([[0, 1, 2]]))
    assert batch.weight.tolist() == [[1, 1, 1]]
    assert batch.peak.tolist() == [[0.0, 0.5, 1.0]]


def test_the_same_generator_state_gives_the_same_batch_and_torchs_own_is_untouched():
    batch = gaussians(4)
    before = torch.random.get_rng_state()
    a, b, c = (Augmentation(180.0, photometric=1.0)(batch, np.random.default_rng(seed)) for seed in (7, 7, 8))
    assert torch.equal(a.images, b.images)
    assert torch.equal(a.u, b.u)
    assert not torch.equal(a.images, c.images)
    assert torch.equal(before, torch.random.get_rng_state())


def test_changes_of_light_and_focus_move_nothing():
    """A Gaussian's centroid, over what it stands on, stays within 0.01 px."""
    rows, columns = np.mgrid[:120, :160]
    at = np.array([82.3, 57.6])
    far = np.hypot(columns - at[0], rows - at[1])
    image = torch.from_numpy(0.3 + 0.3 * np.exp(-((far / 4) ** 2) / 2)).float().expand(16, 3, -1, -1)
    ring, disc = (far > 25) & (far < 40), far < 16
    plane = np.column_stack([columns.ravel(), rows.ravel(), np.ones(rows.size)])
    torch.manual_seed(0)
    changes = list(Augmentation(photometric=1.0).light().children())
    assert len(changes) == 6
    assert isinstance(changes[-1], K.RandomGaussianNoise)  # a pixel's own: it has no geometry
    for change in changes[:-1]:
        found = []
        for moved in change(image).numpy():
            grey = moved.mean(0)
            ground = (plane @ np.linalg.lstsq(plane[ring.ravel()], grey[ring], rcond=None)[0]).reshape(grey.shape)
            mass = np.where(disc, grey - ground, 0)
            found.append([(columns * mass).sum() / mass.sum(), (rows * mass).sum() / mass.sum()])
        assert np.abs(np.array(found) - at).max() < 0.01, type(change).__name__


def test_photometric_changes_keep_the_labels():
    batch = gaussians(8, low=0.3, high=0.7)
    images = (0.2 + 0.5 * batch.images.sum(1, keepdim=True)).expand(-1, 3, -1, -1).clamp(0, 1)
    for seed in range(2):
        moved = Augmentation(0.0, (1.0, 1.0), photometric=1.0)(
            Batch(images, batch.u, batch.visibility), np.random.default_rng(seed)
        )
        assert torch.equal(moved.u, batch.u)
        assert 0 <= moved.images.min()
        assert moved.images.max() <= 1
        # The centre of mass of the difference from the ground stays: compare with the original by correlation.
        shift = [
            np.unravel_index(np.argmax(_correlation(a, b)), a.shape)
            for a, b in zip(images.mean(1).numpy(), moved.images.mean(1).numpy(), strict=True)
        ]
        assert sum(s == (0, 0) for s in shift) >= 6  # a glint or an occluder may outweigh the Gaussians


def test_a_share_of_the_batch_is_changed_photometrically():
    batch = gaussians(4)
    changed = Augmentation(0.0, (1.0, 1.0), photometric=1.0, photometric_share=0.5)(batch, np.random.default_rng(0))
    assert torch.equal(changed.images[2:], batch.images[2:])
    assert torch.equal(changed.visibility[2:], batch.visibility[2:])
    assert all((a != b).any() for a, b in zip(changed.images[:2], batch.images[:2], strict=True))


def _correlation(a, b):
    a, b = (np.fft.fft2(x - x.mean()) for x in (a, b))
    return np.fft.ifft2(a * b.conj()).real


def test_leaving_the_frame():
    u = torch.tensor([[[-0.6, 5.0], [7.4, 7.4], [torch.nan, torch.nan]]])
    assert leave_frame(u, torch.full((1, 3), 2), (8, 8)).tolist() == [[0, 2, 2]]


def test_impossible_ranges_are_named():
    with pytest.raises(ValueError, match="zoom"):
        Augmentation(zoom=(0.0, 1.0))
    with pytest.raises(ValueError, match="photometric"):
        Augmentation(photometric=2.0)
    with pytest.raises(ValueError, match="photometric_share"):
        Augmentation(photometric_share=-0.1)
