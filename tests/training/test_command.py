"""The commands `train` and `evaluate`, fine-tuning on labelled frames, and the model card."""

import json

import numpy as np
import pytest
import torch

from lib import paths
from lib.landmarks import Detector
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.network import HourglassConfig, StackedHourglass
from lib.training.assembly import card
from lib.training.command import main, main_evaluate
from lib.training.loop import load_training
from lib.training.stages import finetune
from tests.toys import toy_images


def test_the_train_command_names_what_is_missing(tmp_path, capsys):
    assert main(["frame", "--data", str(tmp_path), "--folder", str(tmp_path)]) == 2
    assert "no shard" in capsys.readouterr().err
    assert main(["assemble", "--data", str(tmp_path), "--folder", str(tmp_path)]) == 2
    assert "last.safetensors" in capsys.readouterr().err


@pytest.mark.skipif(
    not (paths.SHIPPED_RECORDING.exists() and (paths.MODELS / "default.safetensors").exists()),
    reason="the shipped recording and weights are not there",
)
def test_the_evaluate_command(tmp_path, capsys):
    out = tmp_path / "scores.json"
    assert main_evaluate([str(paths.SHIPPED_RECORDING), "--every", "12", "--json", str(out)]) == 0
    assert "PCK@0.05" in capsys.readouterr().out
    assert set(json.loads(out.read_text())) >= {"all", "base", "tip_1", "tip_2"}
    assert main_evaluate([str(tmp_path)]) == 2


def test_the_card_beside_the_shipped_weights_is_theirs():
    path = paths.MODELS / "default.safetensors"
    assert card(Detector.load(), path) == path.with_name("README.md").read_text(encoding="utf-8")


def test_stages_are_fine_tuned_on_labelled_frames(tmp_path):
    """All stages of a small detector learn, one step each, and resume; images without a labelled base are left out."""
    torch.manual_seed(0)
    images = toy_images(24, size=(540, 960))
    images[0] = images[0]._replace(u=np.full((3, 2), np.nan))
    hourglass = StackedHourglass(HourglassConfig(4, 1, 2))
    detector = Detector(
        hourglass, reduction=8, tool_network=hourglass, window_network=hourglass,
        error_models={name: ErrorModel(logit=(9.0, 0.0, 0.0, 0.0)) for name in ("frame", "tool", "window")},
    )  # fmt: skip
    options = {"steps": 1, "progress": False}
    tuned = finetune(detector, images[:6], images[6:], tmp_path, **options)
    assert set(tuned.error_models) == {"frame", "tool", "window"}
    for stage, network in tuned.networks.items():
        log = load_training(tmp_path / stage / "last.safetensors")
        assert log.provenance["steps"] == 1 and log.provenance["images"] == (15 if stage == "window" else 5)
        assert any((a != b).any() for a, b in zip(network.parameters(), hourglass.parameters(), strict=True))
    again = finetune(detector, images[:6], images[6:], tmp_path, **options)
    assert again.error_models == tuned.error_models
    with pytest.raises(ValueError, match="none has a labelled base and tip"):
        finetune(detector, images[:1], images[6:], tmp_path / "none", **options)


def test_fine_tuning_needs_recordings_and_a_file(capsys):
    assert main(["finetune"]) == 2
    assert "--out" in capsys.readouterr().err
