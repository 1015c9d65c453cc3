"""The launcher: pins and lock, the stamp, repair, system libraries, builds of torch."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import threading
import time

import pytest
from packaging.markers import Marker

from lib import environment, paths
from lib.environment import Problem

LIBRARIES = {"libEGL.so.1": "libegl1", "libGL.so.1": "libgl1"}
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

    def make_venv(venv, uv):
        times.append(time.monotonic())
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)

    monkeypatch.setattr(environment, "_make_venv", make_venv)
    monkeypatch.setattr(environment._Installer, "__call__", lambda self, what, arguments, total=0: None)
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
    command = [str(environment.python_of(moved / ".venv")), "-c", "import lib; print(lib.__file__)"]
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

        patch.setattr(environment, "_install_torch", killed)
        with pytest.raises(KeyboardInterrupt):
            environment.ensure(root)
    assert stamp(root)["state"] == "making"
    (root / ".venv" / "half_a_package").touch()
    environment.ensure(root)
    assert stamp(root)["state"] == "ready" and len(made) == 2
    assert not (root / ".venv" / "half_a_package").exists()


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


def test_missing_libraries_stop_before_anything_is_made(root, made, monkeypatch, capsys):
    monkeypatch.setattr(environment, "_loads", lambda name: False)
    monkeypatch.setattr(environment, "_apt_install", lambda packages: False)
    monkeypatch.setattr(environment.shutil, "which", lambda name: "/usr/bin/apt-get" if name == "apt-get" else None)
    with pytest.raises(Problem, match="sudo apt-get install -y libegl1 libgl1 libusb-1.0-0"):
        environment.ensure(root)
    assert not made and not (root / ".venv").exists()


def test_missing_libraries_are_installed_where_that_is_allowed(monkeypatch):
    monkeypatch.setattr(environment, "_makes_environments", lambda: True)
    there = {"libGL.so.1"}
    asked = []

    def install(packages):
        asked.extend(packages)
        there.update(LIBRARIES)
        return True

    environment.check_system(LIBRARIES, loads=there.__contains__, install=install)
    assert asked == ["libegl1"]


def test_too_little_disk(tmp_path):
    with pytest.raises(Problem, match=r"needs 1300000000 GB of free disk"):
        environment._check_disk(tmp_path, 1e9)


def test_no_ensurepip_says_what_to_type(monkeypatch):
    """What Debian's python3 without python3-venv looks like."""
    monkeypatch.setattr(environment, "_makes_environments", lambda: False)
    monkeypatch.setattr(environment.shutil, "which", lambda name: "/usr/bin/apt-get" if name == "apt-get" else None)
    with pytest.raises(Problem, match=r"sudo apt-get install -y python3\.\d+-venv"):
        environment.check_system({}, install=lambda packages: False)


def test_a_failing_installer_shows_its_last_words(tmp_path, monkeypatch):
    installer = environment._Installer(tmp_path / ".venv", None, (tmp_path / "lock").open("wb"))
    words = [sys.executable, "-c", "print('ERROR: no route to host'); raise SystemExit(1)"]
    monkeypatch.setattr(installer, "command", lambda arguments: words)
    with pytest.raises(Problem, match="Installing packages failed:\n    ERROR: no route to host"):
        installer("packages", [])


# --- builds of torch, sources of packages

INDEXES = {"cpu_index": "https://cpu", "windows_cuda_index": "https://cuda"}


def test_a_cpu_user_on_linux_never_gets_the_default_build():
    attempts = environment.torch_attempts("2.13.0", "cpu", "linux", INDEXES)
    assert attempts[0] == ["--no-deps", "torch==2.13.0+cpu"]
    assert attempts[1] == ["--no-deps", "--index-url", "https://cpu", "torch==2.13.0"]
    assert len(attempts) == 2


def test_a_cuda_user_never_gets_the_cpu_build():
    assert environment.torch_attempts("2.13.0", "cuda", "linux", INDEXES) == [["torch==2.13.0,!=2.13.0+cpu"]]
    assert environment.torch_attempts("2.13.0", "cuda", "win32", INDEXES)[0][:2] == ["--index-url", "https://cuda"]
    with pytest.raises(Problem, match="no CUDA on a Mac"):
        environment.torch_attempts("2.13.0", "cuda", "darwin", INDEXES)


def test_elsewhere_the_default_build_is_the_cpu_build():
    assert environment.torch_attempts("2.13.0", "cpu", "darwin", INDEXES) == [["--no-deps", "torch==2.13.0"]]


def test_uv_gets_the_sources_of_pip():
    arguments = environment._uv_sources({"extra-index-url": "https://a https://b", "find-links": "/wheels"})
    assert arguments == [
        *("--index", "https://a", "--index", "https://b", "--find-links", "/wheels"),
        *("--index-strategy", "unsafe-best-match"),
    ]
    assert environment._uv_sources({}) == []


def test_pip_configuration_is_read(monkeypatch):
    monkeypatch.setenv("PIP_FIND_LINKS", "/a/folder")
    assert environment._pip_configuration(sys.executable)["find-links"] == "/a/folder"
