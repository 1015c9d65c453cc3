import numpy as np
import pytest
import torch

from lib.landmarks.network import HourglassConfig, OffsetConfig, OffsetNetwork, StackedHourglass
from notebooks.studies.training import ABLATION


@pytest.mark.parametrize("name", ABLATION)
def test_shapes_of_the_five_configurations(name):
    config = HourglassConfig(features=8, **ABLATION[name])
    outputs = StackedHourglass(config)(torch.rand(2, 3, 128, 192))
    assert len(outputs) == config.stacks
    assert all(o.shape == (2, 3, 128 // config.stride, 192 // config.stride) for o in outputs)
    assert config.stride == (64 if name == "encoder" else 4)


@pytest.mark.parametrize("size", [(1, 1), (63, 65), (100, 131), (270, 480)])
def test_odd_sizes_are_padded_and_cropped(size):
    (heatmaps,) = StackedHourglass(HourglassConfig(8, 1)).eval()(torch.rand(1, 3, *size))
    assert heatmaps.shape == (1, 3, -(-size[0] // 4), -(-size[1] // 4))


def test_full_hd_is_padded_to_a_multiple_of_64():
    assert HourglassConfig().multiple == 64
    assert 1080 + -1080 % HourglassConfig().multiple == 1088


def test_padding_is_the_callers_own_zeros():
    network = StackedHourglass(HourglassConfig(8, 1)).eval()
    image = torch.rand(1, 3, 100, 90)
    by_hand = torch.nn.functional.pad(image, (0, 38, 0, 28))
    with torch.no_grad():
        assert torch.allclose(network(image)[-1], network(by_hand)[-1][..., :25, :23], atol=1e-6)


@pytest.mark.parametrize("name", ABLATION)
def test_fused_network_gives_the_same_heatmaps(name):
    torch.manual_seed(0)
    network = StackedHourglass(HourglassConfig(features=8, **ABLATION[name]))
    with torch.no_grad():
        for _ in range(3):  # batch statistics that are not the initial ones
            network.train()(torch.rand(4, 3, 64, 64))
        for head in network.heads:
            torch.nn.init.normal_(head.weight, std=0.1)
        image = torch.rand(1, 3, 64, 128)
        expected = network.eval()(image)[-1]
        assert expected.std() > 1e-3
        assert torch.allclose(network.fused()(image)[-1], expected, atol=1e-4)


def test_the_stem_and_the_hourglass_keep_the_half_pixel_rule():
    """A network whose weights are mirror-symmetric maps a mirrored image to mirrored heatmaps, cell by cell."""
    torch.manual_seed(0)
    network = StackedHourglass(HourglassConfig(8, 1)).eval().double()
    with torch.no_grad():
        for p in network.parameters():
            if p.ndim == 4:
                p.copy_((p + p.flip(-1)) / 2)
                p.mul_(2)
        image = torch.rand(1, 3, 64, 128, dtype=torch.float64)
        out, mirrored = network(image)[-1], network(image.flip(-1))[-1]
    assert out.std() > 0
    assert torch.allclose(out.flip(-1), mirrored, atol=1e-9)


@pytest.mark.parametrize("shape", [(1, 1, 64, 64), (1, 4, 64, 64), (3, 64, 64)])
def test_wrong_channels_are_named(shape):
    with pytest.raises(ValueError, match="images: the network takes"):
        StackedHourglass(HourglassConfig(8, 1))(torch.rand(*shape))


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"features": 7}, "features"),
        ({"stacks": 0}, "stacks"),
        ({"depth": 0}, "depth"),
        ({"decoder": False}, "skips"),
        ({"decoder": False, "skips": False}, "stacks"),
    ],
)
def test_impossible_configurations_are_named(changes, name):
    with pytest.raises(ValueError, match=name):
        HourglassConfig(**changes)


def test_deeper_ablation_columns_have_more_parameters():
    sizes = [
        sum(p.numel() for p in StackedHourglass(HourglassConfig(features=16, **c)).parameters())
        for n, c in ABLATION.items()
        if n != "+ residual"  # bottlenecks are thinner than plain 3 x 3 convolutions
    ]
    assert np.all(np.diff(sizes) > 0)


def test_offset_network_starts_in_the_middle_and_survives_fusing():
    torch.manual_seed(0)
    network = OffsetNetwork(OffsetConfig(8, 48))
    network(torch.rand(8, 3, 48, 48))  # batch statistics
    network.eval()
    images = torch.rand(3, 3, 48, 48)
    with torch.inference_mode():
        (found,) = network(images)
        assert torch.equal(found, torch.zeros(3, 4))
        torch.nn.init.normal_(network.head[-1].weight)
        (found,), (fused,) = network(images), network.fused()(images)
    assert found.std() > 0.1
    assert torch.allclose(fused, found, atol=1e-4 * float(found.abs().max()))


def test_offset_networks_name_what_they_cannot_take():
    with pytest.raises(ValueError, match="size_px"):
        OffsetConfig(size_px=40)
    with pytest.raises(ValueError, match="features"):
        OffsetConfig(features=0)
    for shape in ((1, 3, 32, 64), (1, 1, 64, 64), (3, 64, 64)):
        with pytest.raises(ValueError, match="images"):
            OffsetNetwork()(torch.zeros(shape))
