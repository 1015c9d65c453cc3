"""The launcher: pins and lock, the stamp, repair, system libraries, builds of torch."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import threading
import time
import venv as venv_module

import pytest
from packaging.markers import Marker

from lib import environment, paths
from lib.environment import Problem

LOCK = (paths.ROOT / "lib" / "environment.lock").read_text(encoding="utf-8")


def locked() -> list[tuple[str, str, Marker | None]]:
    """(name, version, marker) of every line of the lock."""
    found = re.findall(r"^([A-Za-z0-9._-]+)==(\S+)(?: ; (.*?))? \\$", LOCK, re.MULTILINE)
    return [(name, version, Marker(marker) if marker else None) for name, version, marker in found]


# --- pins and lock


def direct_pins() -> list[str]:
    manifest = environment.manifest()
    groups = [pin for group in manifest["tool"]["workbench"]["groups"] for pin in manifest["dependency-groups"][group]]
    return [pin.split(";")[0].strip() for pin in manifest["project"]["dependencies"] + groups]


def test_every_pin_is_exact_and_locked():
    versions = {(name, version) for name, version, _ in locked()}
    for pin in direct_pins():
        name, version = pin.split("==")
        assert name == "torch" or (name, version) in versions, f"{pin}: run `python3 -m lib lock`"


def test_every_pin_says_who_needs_it():
    for line in (paths.ROOT / "environment.toml").read_text(encoding="utf-8").splitlines():
        if re.match(r'\s+"[\w-]+==', line) and not line.lstrip().startswith(
            ('"open3d==', '"openvino==')
        ):  # the line before it says
            assert re.search(r"#\s+\S{4}", line), line


def test_lock_has_hashes_and_no_hosts():
    assert "://" not in LOCK and "file:" not in LOCK
    blocks = re.split(r"\n(?=[a-z])", LOCK)[1:]
    assert len(blocks) == len(locked()) > 100
    assert all("--hash=sha256:" in block for block in blocks)


def test_lock_leaves_torch_and_its_cuda_out():
    assert not [name for name, _, _ in locked() if re.match(r"torch$|triton|nvidia-|cuda-", name)]


MACHINES = [("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64"), ("win32", "AMD64")]


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13", "3.14"])
@pytest.mark.parametrize(("platform", "machine"), MACHINES)
def test_one_version_of_each_package_for_each_machine(python, platform, machine):
    here = {"sys_platform": platform, "platform_machine": machine, "python_version": python,
            "python_full_version": f"{python}.5", "os_name": "nt" if platform == "win32" else "posix",
            "platform_system": {"linux": "Linux", "darwin": "Darwin", "win32": "Windows"}[platform]}  # fmt: skip
    names = [name for name, _, marker in locked() if marker is None or marker.evaluate(here)]
    assert len(names) == len(set(names))
    assert {"numpy", "open3d-cpu" if (platform, machine) == ("linux", "x86_64") else "open3d"} <= set(names)


# --- making, keeping and repairing .venv, with an installer that installs nothing


@pytest.fixture
def made(monkeypatch):
    """A list that grows by one for each environment made from nothing."""
    times = []

    def make_venv(venv):
        times.append(time.monotonic())
        venv_module.create(venv, with_pip=False)

    monkeypatch.setattr(environment, "_make_venv", make_venv)
    monkeypatch.setattr(environment, "_install", lambda venv, what, arguments, lock_file, uv=None: None)
    monkeypatch.setattr(environment, "_loads", lambda name: True)
    monkeypatch.setattr(environment, "_has_nvidia_gpu", lambda: False)
    monkeypatch.setattr(environment, "_check_disk", lambda folder, gb: None)
    return times


@pytest.fixture
def root(tmp_path):
    """A workbench with nothing in its lock."""
    (tmp_path / "lib").mkdir()
    shutil.copy(paths.ROOT / "environment.toml", tmp_path)
    (tmp_path / "lib" / "environment.lock").write_text("", encoding="utf-8")
    (tmp_path / "lib" / "__init__.py").write_text("", encoding="utf-8")
    return tmp_path


def stamp(root) -> dict:
    return json.loads((root / ".venv" / "microstereo.json").read_text(encoding="utf-8"))


def test_made_once_then_kept(root, made):
    python = environment.ensure(root)
    assert stamp(root)["state"] == "ready" and stamp(root)["torch"] == "cpu"
    start = time.perf_counter()
    assert environment.ensure(root) == python
    assert time.perf_counter() - start < 0.3
    assert len(made) == 1


def test_lib_is_imported_from_any_folder_and_after_a_move(root, made, tmp_path_factory):
    environment.ensure(root)
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    moved = elsewhere / "moved"
    shutil.move(root, moved)
    command = [str(environment.python_of(moved / ".venv")), "-E", "-c", "import lib; print(lib.__file__)"]
    answer = subprocess.run(command, cwd=elsewhere, capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == str(moved / "lib" / "__init__.py")


def test_jupyterlab_asks_for_no_build(root, made):
    environment.ensure(root)
    page_config = root / ".venv" / "etc" / "jupyter" / "labconfig" / "page_config.json"
    assert json.loads(page_config.read_text(encoding="utf-8")) == {"buildCheck": False, "buildAvailable": False}


def test_half_made_is_made_anew(root, made, monkeypatch):
    with monkeypatch.context() as patch:

        def killed(*_):
            raise KeyboardInterrupt

        patch.setattr(environment, "_write_site_files", killed)
        with pytest.raises(KeyboardInterrupt):
            environment.ensure(root)
    assert stamp(root)["state"] == "making"
    (root / ".venv" / "half_a_package").touch()
    environment.ensure(root)
    assert stamp(root)["state"] == "ready" and len(made) == 2
    assert not (root / ".venv" / "half_a_package").exists()


def test_a_stop_while_it_is_removed_blocks_no_new_start(root, made, monkeypatch):
    """A folder may list the stamp first; but what takes long is removed before it."""
    environment.ensure(root)
    venv, removed, remove = root / ".venv", [], shutil.rmtree
    environment.write_text(venv / "microstereo.json", json.dumps({"state": "making", "torch": "cpu"}))

    def stopped(path, **options):
        (path / "microstereo.json").unlink(missing_ok=True)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(environment.shutil, "rmtree", stopped)
        with pytest.raises(KeyboardInterrupt):
            environment.ensure(root)
        patch.setattr(environment.shutil, "rmtree", lambda path, **options: removed.append(path) or remove(path, **options))
        environment.ensure(root)
    assert stamp(root)["state"] == "ready" and len(made) == 2
    assert removed[-1] == venv and {path for path in venv.iterdir() if path.is_dir() and path.name != "etc"} <= {*removed}


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_the_environment_behind_a_link_is_not_removed(root, made, monkeypatch):
    other = root / "other"
    (other / "lib").mkdir(parents=True)
    (other / "microstereo.json").write_text(json.dumps({"state": "making", "torch": "cpu"}), encoding="utf-8")
    (root / ".venv").symlink_to(other)
    monkeypatch.setattr(environment, "_make_venv", lambda venv: (_ for _ in ()).throw(Problem("a link")))
    with pytest.raises(Problem, match="a link"):
        environment.ensure(root)
    assert (other / "lib").is_dir()


def test_a_lost_interpreter_is_made_anew(root, made):
    python = environment.ensure(root)
    python.unlink()
    assert environment.ensure(root).exists() and len(made) == 2


def test_a_changed_pin_updates_without_making_anew(root, made):
    environment.ensure(root)
    before = stamp(root)
    with open(root / "environment.toml", "a", encoding="utf-8") as file:
        file.write("# changed\n")
    environment.ensure(root)
    assert len(made) == 1 and stamp(root)["digest"] != before["digest"]


def test_the_build_of_torch_is_kept_until_another_is_asked_for(root, made):
    environment.ensure(root, torch="cuda")
    environment.ensure(root)
    assert stamp(root)["torch"] == "cuda"
    environment.ensure(root, torch="cpu")
    assert stamp(root)["torch"] == "cpu" and len(made) == 1


def test_somebody_elses_environment_is_not_touched(root, made):
    (root / ".venv").mkdir()
    (root / ".venv" / "precious").touch()
    with pytest.raises(Problem, match="was not made by microstereo"):
        environment.ensure(root)
    assert (root / ".venv" / "precious").exists()


def test_two_at_a_time_make_it_once(root, made):
    threads = [threading.Thread(target=environment.ensure, args=(root,)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1 and stamp(root)["state"] == "ready"


# --- what the machine lacks


def test_missing_libraries_stop_nothing_and_are_told_in_one_line(root, made, monkeypatch, capsys):
    monkeypatch.setattr(environment, "_loads", lambda name: name == "libGL.so.1")
    monkeypatch.setattr(environment.sys, "platform", "linux")
    environment.ensure(root)
    assert stamp(root)["state"] == "ready"
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "Open3D" in line]
    assert "all else runs" in line and line.endswith("apt-get install libegl1 libusb-1.0-0")
    assert environment.missing_libraries({"libGL.so.1": "libgl1"}) == ""


def test_the_launcher_asks_for_no_rights():
    text = (paths.ROOT / "lib" / "environment.py").read_text(encoding="utf-8")
    assert "sudo" not in text and "unsafe-best-match" not in text


def test_too_little_disk(tmp_path):
    with pytest.raises(Problem, match=r"needs 1300000000 GB of free disk"):
        environment._check_disk(tmp_path, 1e9)


def test_no_ensurepip_says_what_to_install(tmp_path, monkeypatch):
    """What Debian's python3 without python3-venv looks like."""
    monkeypatch.setattr(environment.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(environment.shutil, "which", lambda name: None)
    with pytest.raises(Problem, match=r"install python3\.\d+-venv \(or uv\), then start again"):
        environment._make_venv(tmp_path / ".venv")


def test_a_failing_installer_shows_its_last_words(tmp_path, monkeypatch):
    words = "import sys; print('ERROR: no route to', sys.argv[-1]); raise SystemExit(1)"
    (tmp_path / "python").write_text(f'#!/bin/sh\nexec {sys.executable} -c "{words}" "$@"\n')
    (tmp_path / "python").chmod(0o755)
    monkeypatch.setattr(environment, "python_of", lambda venv: tmp_path / "python")
    with (tmp_path / "lock").open("wb") as lock, pytest.raises(Problem, match="packages failed:\n    ERROR: no route to x"):
        environment._install(tmp_path, "packages", ["x"], lock)


def test_where_uv_fails_pip_installs(root, made, monkeypatch):
    """uv knows nothing of pip's configuration, such as a mirror or a folder of wheels."""
    asked = []

    def install(venv, what, arguments, lock_file, uv=None):
        asked.append((what, uv))
        if uv:
            raise Problem("no route to host")

    monkeypatch.setattr(environment.shutil, "which", lambda name: "/bin/uv" if name == "uv" else None)
    monkeypatch.setattr(environment, "_install", install)
    environment.ensure(root)
    assert asked == [("packages", "/bin/uv"), ("packages with pip", None), ("torch (cpu)", None)]


# --- builds of torch

INDEXES = {"cpu_index": "https://cpu", "windows_cuda_index": "https://cuda"}


def test_a_cpu_user_on_linux_never_gets_the_default_build():
    arguments = environment.torch_arguments("2.13.0", "cpu", "linux", INDEXES)
    assert arguments == ["--no-deps", "--extra-index-url", "https://cpu", "torch==2.13.0+cpu"]


def test_a_cuda_user_never_gets_the_cpu_build():
    assert environment.torch_arguments("2.13.0", "cuda", "linux", INDEXES) == ["torch==2.13.0,!=2.13.0+cpu"]
    assert environment.torch_arguments("2.13.0", "cuda", "win32", INDEXES)[:2] == ["--index-url", "https://cuda"]
    with pytest.raises(Problem, match="no CUDA on a Mac"):
        environment.torch_arguments("2.13.0", "cuda", "darwin", INDEXES)


def test_elsewhere_the_default_build_is_the_cpu_build():
    assert environment.torch_arguments("2.13.0", "cpu", "darwin", INDEXES) == ["--no-deps", "torch==2.13.0"]
