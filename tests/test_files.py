"""Files appear whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from lib import files


def test_failed_write_leaves_the_old_file_and_no_partial(tmp_path):
    target = tmp_path / "rig.json"
    files.write_json(target, {"a": 1})
    with pytest.raises(ValueError):
        files.write_json(target, {"a": float("nan")})
    with pytest.raises(RuntimeError), files.whole(target) as partial:
        partial.write_text("half")
        raise RuntimeError
    with pytest.raises(FileNotFoundError), files.whole(target):
        pass  # a writer that wrote nothing has failed
    with pytest.raises(FileNotFoundError, match=r"a\.json: there is no folder .*nowhere; make it"):
        files.write_json(tmp_path / "nowhere" / "a.json", 1)
    assert target.read_text() == '{\n "a": 1\n}\n' and [p.name for p in tmp_path.iterdir()] == ["rig.json"]


def test_full_disk_is_an_error(tmp_path, monkeypatch):
    target = tmp_path / "points.ply"
    files.write_text(target, "old")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="space"):
        files.write_bytes(target, b"new")
    assert target.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_partial_keeps_the_suffix(tmp_path):
    with files.whole(tmp_path / "a.b.png") as partial:
        assert partial.suffix == ".png" and partial.parent == tmp_path
        partial.touch()


def test_digest_names_content(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_bytes(b"x" * 3_000_000)
    b.write_bytes(b"y")
    assert files.digest(a) == files.digest(a) != files.digest(b) and len(files.digest(a, b, length=64)) == 64
    assert files.digest(a, str(b)) == files.digest(b"x" * 3_000_000, b"y") == files.digest(a, memoryview(b"y"))
    with pytest.raises(FileNotFoundError, match="missing"):
        files.digest(Path("missing"))
