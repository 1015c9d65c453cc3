"""The commands `train` and `evaluate`, fine-tuning on labelled frames, and the model card."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lib import paths
from lib.__main__ import COMMANDS
from lib.landmarks import Detector, Landmarks
from lib.landmarks.detector import CLOSE
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.network import HourglassConfig, OffsetConfig, OffsetNetwork, StackedHourglass
from lib.recordings import Annotations, Recording
from lib.training import command, stages
from lib.training.command import main_evaluate
from lib.training.evaluation import evaluate
from lib.training.loop import load_training
from lib.training.sources import FrameSource
from tests.toys import toy_images


def test_the_train_command_names_what_is_missing(tmp_path, capsys):
    assert COMMANDS["train"](["frame", "--data", str(tmp_path), "--folder", str(tmp_path)]) == 2
    assert "no shard" in capsys.readouterr().err
    assemble = ["assemble", "--data", str(tmp_path), "--folder", str(tmp_path)]
    assert COMMANDS["train"](assemble) == 2  # it would replace the detector that ships
    assert "--out" in capsys.readouterr().err
    assert COMMANDS["train"]([*assemble, "--out", str(tmp_path / "weights.safetensors")]) == 2
    assert "last.safetensors" in capsys.readouterr().err
    assert COMMANDS["train"](["generate", "--data", str(tmp_path), "--photographs", str(tmp_path)]) == 2
    assert "holds no .png or .jpg" in capsys.readouterr().err
    (tmp_path / "torn.png").write_bytes(b"no image")
    assert COMMANDS["train"](["generate", "--data", str(tmp_path), "--photographs", str(tmp_path)]) == 2
    assert "torn.png" in capsys.readouterr().err


@pytest.mark.skipif(
    not (paths.SHIPPED_RECORDING.exists() and (paths.MODELS / "default.safetensors").exists()),
    reason="the shipped recording and weights are not there",
)
def test_the_evaluate_command(tmp_path, capsys, monkeypatch):
    out = tmp_path / "scores.json"
    torch_engine = Detector.load(engine="torch")  # another engine would first be compiled
    monkeypatch.setattr(Detector, "load", classmethod(lambda cls, weights: torch_engine))
    assert main_evaluate([str(paths.SHIPPED_RECORDING), "--every", "20", "--json", str(out)]) == 0
    assert "PCK@0.05" in capsys.readouterr().out
    assert set(json.loads(out.read_text())) >= {"all", "base", "tip_1", "tip_2"}
    alike = lambda shown: Landmarks(np.zeros((1, 3, 2)), np.full((1, 3, 2, 2), np.nan), np.ones((1, 3)))  # noqa: E731
    monkeypatch.setattr(Detector, "load", classmethod(lambda cls, weights: alike))
    assert main_evaluate([str(paths.SHIPPED_RECORDING), "--every", "20", "--json", str(out)]) == 0
    assert json.loads(out.read_text())["all"]["nees"] is None
    assert COMMANDS["evaluate"]([str(tmp_path)]) == 2
    with pytest.raises(SystemExit):
        main_evaluate([str(paths.SHIPPED_RECORDING), "--json", str(tmp_path / "nowhere" / "scores.json")])
    assert "there is no folder" in capsys.readouterr().err


def test_the_card_beside_the_shipped_weights_is_theirs():
    path = paths.MODELS / "default.safetensors"
    assert stages.card(Detector.load(engine="torch"), path) == path.with_name("README.md").read_text(encoding="utf-8")


def test_a_stage_begins_from_a_checkpoint_or_from_shipped_weights():
    shipped = command._start(Path("default"), "closeup")
    assert shipped.provenance == Detector.load(engine="torch").metadata["stages"]["closeup"]
    with pytest.raises(FileNotFoundError, match="nowhere"):
        command._start(Path("nowhere"), "closeup")


def test_stages_are_fine_tuned_on_labelled_frames(tmp_path, monkeypatch):
    """Every stage of a small detector learns, one step each, and resumes; images without a labelled base are left out."""
    torch.manual_seed(0)
    images = toy_images(8, size=(270, 480))
    images[0] = images[0]._replace(u=np.full((3, 2), np.nan))
    hourglass, closeup = StackedHourglass(HourglassConfig(4, 1, 2)), OffsetNetwork(OffsetConfig(4, 64))
    metadata = {"trained_on": "toys"}
    detector = Detector(hourglass, 96, tool_network=hourglass, closeup_network=closeup, metadata=metadata)
    fitted_on, done = [], []
    monkeypatch.setattr(stages, "fit_error_models", lambda d, held_out, anew, progress: fitted_on.append(held_out) or d)
    options = {"steps": 1, "progress": lambda stage, part: done.append((stage, part))}
    images[:6] = [one._replace(sd_px=np.array([0.0, 1.0, 3e4])) for one in images[:6]]  # the second tip is not believed
    weights, of = [], FrameSource.of
    noted = lambda found, **how: weights.append(how.get("weight")) or of(found, **how)  # noqa: E731
    monkeypatch.setattr(FrameSource, "of", noted)
    tuned = stages.finetune(detector, images[:6], images[6:], tmp_path, **options)
    finetuned = tuned.metadata["finetuned"]
    assert (finetuned["images"], finetuned["held_out"]) == (5, 2)  # those with a base and a tip
    assert tuned.metadata["trained_on"] == "toys; then on labelled frames"
    assert sorted(done) == [("closeup", 1.0), ("frame", 1.0), ("tool", 1.0)]  # side by side
    for stage, network in tuned.networks.items():
        provenance = load_training(tmp_path / stage / "last.safetensors").provenance
        assert provenance["steps"] == 1 and provenance["images"] == (15 if stage == "closeup" else 5)
        before = detector.networks[stage].parameters()
        assert any((a != b).any() for a, b in zip(network.parameters(), before, strict=True))
    again = stages.finetune(detector, images[:6], images[6:], tmp_path, **options)
    for a, b in zip(again.tool_network.parameters(), tuned.tool_network.parameters(), strict=True):
        assert torch.equal(a, b)
    assert [len(held_out) for held_out in fitted_on] == [2, 2]
    assert (weights[0][:, 0] == 1).all() and (weights[0][:, 2] < 1e-3).all()
    auc = lambda d, _: SimpleNamespace(  # noqa: E731
        scores=SimpleNamespace(auc=50.0, pck_0_01=float(d.closeup_network is closeup))
    )
    monkeypatch.setattr(stages, "evaluate", auc)
    before = replace(detector, error_models={stage: ErrorModel() for stage in CLOSE})
    kept = stages.finetune(before, images[:6], images[6:], tmp_path, **options)
    assert kept.closeup_network is closeup and kept.tool_network is not hourglass  # held-out images prefer those from before
    with pytest.raises(ValueError, match="none has a labelled base and tip"):
        stages.finetune(detector, images[:1], images[6:], tmp_path / "none", **options)


def test_assembly_takes_labelled_frames_from_all_over_a_recording(tmp_path, monkeypatch):
    """Labels in ten of the 34 frames; networks, renderer and fits are replaced by stand-ins."""
    images, fitted_on = toy_images(8), []
    recording = Recording.open(paths.SHIPPED_RECORDING)
    seen = np.zeros((len(recording), 3), int)
    seen[[1, 2, 3, 5, 9, 14, 21, 22, 23, 33]] = 2
    labels = Annotations(*np.full((2, len(recording), 3, 2), 40.0), seen, 0 * seen)
    monkeypatch.setattr(Recording, "open", lambda folder: replace(recording, truth=None, annotations=labels))
    monkeypatch.setattr(stages, "validation_images", lambda data: images)
    monkeypatch.setattr(stages, "sample", lambda rng, **options: images[0][1:])
    monkeypatch.setattr(stages, "fit_error_models", lambda d, shown, **options: fitted_on.extend(shown) or d)
    missed = lambda shown: Landmarks.none(len(shown))  # noqa: E731
    monkeypatch.setattr(stages, "evaluate", lambda d, shown, progress: evaluate(missed, shown))
    monkeypatch.setattr(stages, "card", lambda detector, path: "")
    monkeypatch.setattr(Detector, "save", lambda detector, path: None)
    hourglass, closeup = StackedHourglass(HourglassConfig(4, 1, 2)), OffsetNetwork(OffsetConfig(4, 64))
    metadata = {"trained_on": "toys; then on labelled frames"}
    initial = Detector(hourglass, 96, tool_network=hourglass, closeup_network=closeup, metadata=metadata)
    rest = {"recordings": [Path("ours")], "initial": initial}
    made = stages.assemble(tmp_path, tmp_path, tmp_path / "made.safetensors", **rest)
    names = [one.name for one in fitted_on if one.name.startswith("left")]
    assert names == [f"left {i}" for i in (1, 2, 3, 5, 9, 14, 21, 22, 23, 33)] and made.metadata["recorded_frames"] == 10
    assert made.metadata["trained_on"] == "toys; then on labelled frames"


def test_time_ends_fine_tuning(tmp_path, monkeypatch):
    torch.manual_seed(0)
    images = toy_images(4, size=(135, 240))
    monkeypatch.setattr(stages, "fit_error_models", lambda d, held_out, anew, progress: d)
    detector = Detector(StackedHourglass(HourglassConfig(4, 1, 2)), 96)
    for folder, simulated in (("alone", None), ("mixed", toy_images(3, size=(135, 240)))):
        how = {"simulated": simulated, "steps": 10**6, "minutes": 1e-4, "progress": False}
        stages.finetune(detector, images[:2], images[2:], tmp_path / folder, **how)
        trained = load_training(tmp_path / folder / "frame" / "last.safetensors").provenance
        assert trained["steps"] < 100 and trained["images"] == (4 if simulated else 2)  # a third of them fits the doubt


def test_a_stopped_fine_tuning_stops_all_stages(tmp_path, monkeypatch):
    torch.manual_seed(0)
    images = toy_images(4, size=(135, 240))
    monkeypatch.setattr(stages, "fit_error_models", lambda d, held_out, anew, progress: d)
    hourglass = StackedHourglass(HourglassConfig(4, 1, 2))
    detector = Detector(hourglass, 96, tool_network=hourglass)

    def stop(stage: str, part: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stages.finetune(detector, images[:2], images[2:], tmp_path, steps=10**6, progress=stop)


@pytest.mark.parametrize(
    ("words", "said"),
    [("frame --rate 0", "rate: must be positive"), ("frame --seed -1", "seed: must not be negative"),
     ("generate --scenes -1", "scenes: must not"), ("propose --workers 0", "workers: must be at least 1"),
     ("finetune a --out b --every -1", "every: must be at least 1"), ("finetune a --out b --rate 1", "takes no --rate")],
)  # fmt: skip
def test_numbers_that_cannot_be_and_options_without_effect_are_refused(words, said, tmp_path, monkeypatch, capsys):
    for name in ("generate", "propose", "train", "finetune"):  # it does not come to that
        monkeypatch.setattr(command, name, None)
    with contextlib.suppress(SystemExit):
        assert COMMANDS["train"]([*words.split(), "--data", str(tmp_path), "--folder", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


def test_fine_tuning_needs_recordings_and_a_file(tmp_path, monkeypatch, capsys):
    assert COMMANDS["train"](["finetune"]) == 2
    assert "--out" in capsys.readouterr().err
    (tmp_path / "file").touch()
    monkeypatch.setattr(command, "finetune", None)  # it does not come to that
    out = tmp_path / "file" / "a.safetensors"
    assert COMMANDS["train"](["finetune", str(paths.SHIPPED_RECORDING), "--out", str(out)]) == 2
    assert "file" in capsys.readouterr().err


def test_both_views_of_a_frame_are_held_out(tmp_path, monkeypatch, capsys):
    images = [toy_images(1)[0]._replace(name=f"{side} {i}") for i in (3, 4, 7) for side in ("left", "right")]
    parts, tuned = [], SimpleNamespace(save=lambda path: None)
    scores = SimpleNamespace(pck_0_05=0.0, median_px=0.0)
    monkeypatch.setattr(command, "labelled_images", lambda recording, every: images[:-1])  # the cut is within frame 4
    monkeypatch.setattr(command, "finetune", lambda detector, *split, **options: parts.extend(split[:2]) or tuned)
    monkeypatch.setattr(command, "evaluate", lambda *_: SimpleNamespace(scores=scores))
    monkeypatch.setattr(command.Detector, "load", lambda path: None)
    out = tmp_path / "new" / "a.safetensors"
    command.main(["finetune", str(paths.SHIPPED_RECORDING), "--out", str(out), "--data", str(tmp_path)])
    assert [one.name for one in parts[0]] == ["left 3", "right 3"] and len(parts[1]) == 3 and out.parent.is_dir()
