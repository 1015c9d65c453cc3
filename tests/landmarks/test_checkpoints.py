"""Weights files: damaged, incomplete and foreign ones are named with the cure."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from lib import paths
from lib.landmarks import Detector
from lib.landmarks.checkpoints import read_checkpoint, write_checkpoint
from lib.landmarks.detector import FORMAT
from lib.landmarks.error_model import ErrorModel
from lib.landmarks.network import HourglassConfig, StackedHourglass


def untrained(frame_px=64):
    networks = [StackedHourglass(HourglassConfig(4, 1, 1)) for _ in range(2)]
    models = {name: ErrorModel(logit=(5.0, 0.0, 0.0, 0.0)) for name in ("frame", "tool", "again")}
    return Detector(networks[0], frame_px, networks[1], error_models=models)


def test_missing_corrupt_and_foreign_files_are_named(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"nothing\.safetensors"):
        Detector.load(tmp_path / "nothing.safetensors")
    with pytest.raises(FileNotFoundError, match=r"nowhere.default"):
        Detector.load(tmp_path / "nowhere" / "default")  # not the one that ships
    monkeypatch.chdir(tmp_path)
    (tmp_path / "default").mkdir()  # a folder of the name of weights
    assert Detector.load().metadata == Detector.load(paths.MODELS / "default.safetensors").metadata
    with pytest.raises(IsADirectoryError, match=r"it is a folder; give the \.safetensors file in it"):
        Detector.load(tmp_path)
    corrupt = tmp_path / "corrupt.safetensors"
    untrained().save(corrupt)
    corrupt.write_bytes(corrupt.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"corrupt\.safetensors: corrupt"):
        Detector.load(corrupt)
    corrupt.write_bytes(b"PK\x03\x04 a pickle, perhaps")
    with pytest.raises(ValueError, match=r"corrupt\.safetensors: corrupt"):
        Detector.load(corrupt)
    foreign = tmp_path / "foreign.safetensors"
    save_file({"layer": torch.zeros(3)}, foreign)
    with pytest.raises(ValueError, match=r"foreign\.safetensors: holds 'foreign weights'.*get the file again"):
        Detector.load(foreign)


@pytest.mark.parametrize("where", ["metadata", "tensors"])
def test_a_flipped_bit_is_noticed_wherever_it_is(where, tmp_path):
    path = tmp_path / "weights.safetensors"
    untrained().save(path)
    content = bytearray(path.read_bytes())
    header = int.from_bytes(content[:8], "little")
    # In the metadata: a digit of the error model, so that the header can still be read.
    at = content.index(b"[5.0") + 1 if where == "metadata" else (8 + header + len(content)) // 2
    content[at] ^= 1
    path.write_bytes(content)
    for kind in (FORMAT, "microstereo.training"):  # it is damaged, whatever it was to be
        with pytest.raises(ValueError, match=r"weights\.safetensors: damaged.*get the file again"):
            read_checkpoint(path, kind)


def test_missing_metadata_error_models_and_checksums_are_named(tmp_path):
    whole, path = tmp_path / "whole.safetensors", tmp_path / "weights.safetensors"
    detector = untrained()
    detector.save(whole)
    tensors, metadata = read_checkpoint(whole, FORMAT)
    for lacking in ("networks", "frame_px", "calibration", "provenance"):
        write_checkpoint(path, tensors, {name: value for name, value in metadata.items() if name != lacking})
        with pytest.raises(ValueError, match=rf"weights\.safetensors: its metadata lack {lacking}; get the file again"):
            Detector.load(path)
    write_checkpoint(path, tensors, metadata | {"calibration": {"frame": metadata["calibration"]["frame"]}})
    with pytest.raises(ValueError, match=r"weights\.safetensors: no error model for tool, again.*train assemble"):
        Detector.load(path)
    with pytest.raises(ValueError, match="no error model for frame, tool, again"):
        replace(detector, error_models={}).save(whole)
    save_file(tensors, path, {name: json.dumps(value) for name, value in metadata.items()})
    with pytest.raises(ValueError, match=r"weights\.safetensors: damaged, its SHA-256 checksum is missing"):
        Detector.load(path)


def test_halved_weights_take_half_the_place_and_load_as_they_were(tmp_path):
    whole, half = tmp_path / "whole.safetensors", tmp_path / "half.safetensors"
    network = StackedHourglass(HourglassConfig(32, 1))
    errors = {"frame": ErrorModel()}
    Detector(network, 64, error_models=errors).save(whole)
    detector = Detector(network.halved(), 64, error_models=errors)
    detector.save(half)
    assert half.stat().st_size < 0.6 * whole.stat().st_size
    for path, written in ((half, detector.frame_network), (whole, network)):
        loaded = Detector.load(path, engine="torch").frame_network.state_dict()
        assert all(torch.equal(value, loaded[name]) for name, value in written.state_dict().items())
        assert all(value.dtype != torch.half for value in loaded.values())


def test_the_digest_tells_everything_that_decides_what_a_detector_finds():
    detector = untrained()
    weights = detector.networks["tool"].state_dict()
    others = [
        replace(detector, frame_px=32),
        replace(detector, method="paper"),
        replace(detector, engine="openvino"),
        replace(detector, error_models=detector.error_models | {"tool": ErrorModel(logit=(5.5, 0.0, 0.0, 0.0))}),
    ]
    before = detector.digest
    assert len({before, *(other.digest for other in others)}) == 5 and replace(detector).digest == before
    with torch.no_grad():
        next(iter(weights.values())).view(-1)[0] += 1e-6
    assert detector.digest != before


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "weights.safetensors"
    untrained().save(path)
    before = path.read_bytes()
    monkeypatch.setattr(Path, "write_bytes", lambda self, data: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(OSError, match=r"weights\.safetensors: not saved \(No space left"):
        untrained(frame_px=32).save(path)
    assert [file.name for file in tmp_path.iterdir()] == ["weights.safetensors"] and path.read_bytes() == before
    with pytest.raises(OSError, match=r"^.*a\.safetensors: not saved \(.*there is no folder"):
        untrained().save(tmp_path / "nowhere" / "a.safetensors")


def test_weights_of_another_network_are_named(tmp_path):
    path = tmp_path / "weights.safetensors"
    network = StackedHourglass(HourglassConfig(8, 1))
    metadata = {
        "format": "microstereo.detector", "networks": {"frame": {"features": 16}}, "frame_px": None,
        "method": "paper", "calibration": {}, "provenance": {},
    }  # fmt: skip
    write_checkpoint(path, {f"frame.{k}": v for k, v in network.state_dict().items()}, metadata)
    with pytest.raises(ValueError, match=r"weights\.safetensors: its weights do not fit"):
        Detector.load(path)


def test_networks_of_a_stage_that_is_none_are_named_and_settings_that_are_gone_are_not(tmp_path):
    path = tmp_path / "weights.safetensors"
    detector = untrained()
    detector.save(path)
    tensors, metadata = read_checkpoint(path, FORMAT)
    write_checkpoint(path, tensors, metadata | {"window_px": 128, "mirror": True})  # as earlier versions wrote them
    assert Detector.load(path, engine="torch").digest == detector.digest
    networks = metadata["networks"] | {"window": metadata["networks"]["tool"]}
    tensors |= {f"window{key[4:]}": value.clone() for key, value in tensors.items() if key.startswith("tool.")}
    write_checkpoint(path, tensors, metadata | {"networks": networks})
    with pytest.raises(ValueError, match=r"weights\.safetensors: it has networks of unknown stages \(window\); train"):
        Detector.load(path)


def test_an_error_model_of_another_version_is_named(tmp_path):
    path = tmp_path / "weights.safetensors"
    untrained().save(path)
    tensors, metadata = read_checkpoint(path, FORMAT)
    old = [[[0.0] * 14, [0.0] * 14], [1.0] * 4]
    write_checkpoint(path, tensors, metadata | {"calibration": {"frame": old, "tool": old}})
    with pytest.raises(ValueError, match=r"safetensors: .*log_variance: expected \(2, 11\), got \(2, 14\); fit anew"):
        Detector.load(path)
