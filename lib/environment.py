"""Makes and checks ``.venv``, the environment in which all commands of the workbench run.

This module uses only the standard library, since it runs on a bare Python.  `ensure` compares a stamp in the environment with
environment.toml and its lock.  An incomplete environment is made again.  One process makes it while others wait.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from lib.files import digest, write_text

ROOT = Path(__file__).resolve().parent.parent
TORCH_BUILDS = ("cpu", "cuda")
_STAMP = "microstereo.json"
#: Packages that the lock leaves out: torch and the CUDA packages that only its default Linux build needs.
_TORCH_PACKAGES = re.compile(r"(torch|triton|nvidia-.*|cuda-.*)")


class Problem(Exception):
    """The environment cannot be made; the text says why and what to do."""


def manifest(root: Path = ROOT) -> dict:
    """The parsed ``environment.toml``."""
    import tomllib  # not at the top, so that an older Python still gets the launcher's message about its version

    return tomllib.loads((root / "environment.toml").read_text(encoding="utf-8"))


def python_of(venv: Path) -> Path:
    """The interpreter of a virtual environment."""
    return venv / "Scripts" / "python.exe" if os.name == "nt" else venv / "bin" / "python"


def ensure(root: Path = ROOT, torch: str | None = None) -> Path:
    """Make, repair or update the ``.venv`` in `root` if needed, and return its interpreter; raises `Problem` on failure.

    `torch` is ``"cpu"`` or ``"cuda"``; None keeps the installed build, or else takes ``"cuda"`` if there is an NVIDIA GPU.
    """
    if not _is_ready(root, torch):
        with _sole_maker(root) as lock_file:
            if not _is_ready(root, torch):  # another process may have made it meanwhile
                _make(root, torch, lock_file)
    return python_of(root / ".venv")


def lock(*, upgrade: bool) -> Path:
    """Write a new lock from environment.toml: every package for every platform, with hashes and without package index.

    Pins that still fit are kept unless `upgrade` is True.  Needs uv (``pip install uv``) and the network.
    """
    uv = shutil.which("uv")
    if not uv:
        raise Problem("Writing the lock needs uv: python3 -m pip install uv")
    workbench = manifest()["tool"]["workbench"]
    path = ROOT / workbench["lock"]
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(ROOT / "environment.toml", Path(folder) / "pyproject.toml")
        if path.exists() and not upgrade:
            shutil.copy(path, Path(folder) / "lock.txt")
        groups = [f"--group={group}" for group in workbench["groups"]]
        options = ["--universal", "--generate-hashes", "--no-annotate", "--no-header", "--quiet", "-o", "lock.txt"]
        _call([uv, "pip", "compile", "pyproject.toml", *groups, *options], "Resolving failed", cwd=folder)
        text = (Path(folder) / "lock.txt").read_text(encoding="utf-8")
    blocks = [b for b in re.split(r"\n(?=[a-zA-Z0-9])", text.strip()) if not _TORCH_PACKAGES.fullmatch(b.split("==")[0])]
    header = "# Made by `python3 -m lib lock` from environment.toml; torch comes by build and is not in here.\n"
    write_text(path, header + "\n".join(blocks) + "\n")
    return path


def _digest(root: Path) -> str:
    contents = [(root / name).read_bytes() for name in ("environment.toml", "lib/environment.lock")]
    return digest(b"\0".join(contents), length=64)


def _read_stamp(venv: Path) -> dict:
    """The stamp: {} if there is none, {"state": "making", ...} if the environment is incomplete."""
    with contextlib.suppress(OSError, ValueError):
        return json.loads((venv / _STAMP).read_text(encoding="utf-8"))
    return {}


def _is_ready(root: Path, torch: str | None) -> bool:
    venv = root / ".venv"
    stamp = _read_stamp(venv)
    return (
        stamp.get("state") == "ready"
        and stamp["digest"] == _digest(root)
        and torch in (None, stamp["torch"])
        and python_of(venv).exists()  # False for a link to an interpreter that was removed
    )


@contextlib.contextmanager
def _sole_maker(root: Path):
    """Hold a lock, which the installer inherits: if this process is killed, the next one waits for the orphaned installer."""
    with open(root / "lib" / "environment.lock", "rb") as file:
        for attempt in itertools.count():
            try:
                _take(file)
                break
            except (BlockingIOError, PermissionError):
                if not attempt:
                    print("Another process is setting up the environment; waiting for it ...", flush=True)
                time.sleep(0.5)
            except OSError:
                break  # a file system without locks: continue without one
        yield file


def _take(file) -> None:
    if os.name == "nt":
        import msvcrt

        file.seek(1 << 30)  # lock a byte that no reader of the file reads
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _make(root: Path, torch: str | None, lock_file) -> None:
    settings, venv = manifest(root), root / ".venv"
    workbench, stamp = settings["tool"]["workbench"], _read_stamp(venv)
    if venv.exists() and not stamp and any(venv.iterdir()):
        raise Problem(f"{venv} was not made by microstereo; move it away and start again.")
    torch = torch or stamp.get("torch") or ("cuda" if _has_nvidia_gpu() else "cpu")
    update = stamp.get("state") == "ready" and python_of(venv).exists()
    if not update:
        for path in () if venv.is_symlink() else venv.glob("*"):  # the stamp goes last, so that a new start knows the folder
            if path.name != _STAMP:
                shutil.rmtree(path, ignore_errors=True)
        shutil.rmtree(venv, ignore_errors=True)
        _check_disk(root, workbench["disk_gb"][torch])
    cost = f"{workbench['disk_gb'][torch]} GB of disk and up to {workbench['download_gb'][torch]} GB of download"
    what = f"{'Updating' if update else 'Making'} the environment in .venv, torch for {torch}"
    print(f"{what}: 1 to 5 minutes, {cost}.", flush=True)
    start = time.monotonic()
    venv.mkdir(exist_ok=True)
    write_text(venv / _STAMP, json.dumps({"state": "making", "torch": torch}))
    if not update:
        _make_venv(venv)
    locked = ["--require-hashes", "--no-deps", "-r", str(root / workbench["lock"])]
    try:
        _install(venv, "packages", locked, lock_file, uv=shutil.which("uv"))
    except Problem:  # uv does not read pip's configuration, such as a mirror
        _install(venv, "packages with pip", locked, lock_file)
    version = next(pin.split("==")[1] for pin in settings["project"]["dependencies"] if pin.startswith("torch=="))
    _install(venv, f"torch ({torch})", torch_arguments(version, torch, sys.platform, workbench["torch"]), lock_file)
    _write_site_files(root, venv)
    write_text(venv / _STAMP, json.dumps({"state": "ready", "digest": _digest(root), "torch": torch}))
    print(f"The environment is ready after {time.monotonic() - start:.0f} s.", flush=True)
    lacks = missing_libraries(workbench["system_libraries"])
    if lacks:
        print(lacks, flush=True)


def _make_venv(venv: Path) -> None:
    """Make an environment that contains only pip, with the interpreter that runs this."""
    interpreter = getattr(sys, "_base_executable", sys.executable)
    if importlib.util.find_spec("ensurepip"):
        command = [interpreter, "-m", "venv", str(venv)]
    elif shutil.which("uv"):
        command = ["uv", "venv", "--quiet", "--seed", "--allow-existing", "--python", interpreter, str(venv)]
    else:  # Debian and Ubuntu have venv in a separate package
        package = f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"
        raise Problem(f"This Python cannot make virtual environments; install {package} (or uv), then start again.")
    _call(command, "The virtual environment cannot be made")


def _install(venv: Path, what: str, arguments: list[str], lock_file, *, uv: str | None = None) -> None:
    """Install into the environment with pip, or with uv if given, and print the seconds that have passed."""
    python = str(python_of(venv))
    pip = [python, "-m", "pip", "install", "--disable-pip-version-check", "--no-input", "--quiet"]
    # Compile the bytecode here, so that kernels and workers start in seconds even where Python may not write bytecode.
    command = [uv, "pip", "install", "--quiet", "--compile-bytecode", "--python", python] if uv else pip
    keep_lock = {} if os.name == "nt" else {"pass_fds": [lock_file.fileno()]}
    start, live = time.monotonic(), sys.stdout.isatty()
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log:
        output = {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": subprocess.STDOUT}
        process = subprocess.Popen([*command, *arguments], **output, **keep_lock)
        try:
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=1 if live else 20)
                line = f"  installing {what}: {time.monotonic() - start:.0f} s"
                print(f"\r\033[K{line}" if live else line, end="" if live else "\n", flush=True)
        except BaseException:
            process.kill()
            process.wait()
            raise
        print("\r\033[K" if live else "", end="")
        log.seek(0)
        tail = "\n".join("    " + line.rstrip() for line in log.readlines()[-15:])
    if process.returncode:
        raise Problem(f"Installing {what} failed:\n{tail}\nCheck the network, then start again.")


def torch_arguments(version: str, build: str, platform: str, indexes: dict) -> list[str]:
    """Arguments of pip for a build of torch; the packages that the CPU build needs are already in the lock."""
    if build == "cuda":
        if platform == "darwin":
            raise Problem("--torch cuda: there is no CUDA on a Mac; leave the option out.")
        if platform == "win32":
            return ["--index-url", indexes["windows_cuda_index"], f"torch=={version}"]
        return [f"torch=={version},!={version}+cpu"]
    if platform == "linux":  # PyPI has no versions with "+", so it comes from PyTorch's index or a configured mirror
        return ["--no-deps", "--extra-index-url", indexes["cpu_index"], f"torch=={version}+cpu"]
    return ["--no-deps", f"torch=={version}"]


def _write_site_files(root: Path, venv: Path) -> None:
    """Make `import lib` work in any folder and kernel, and turn off JupyterLab's build dialog, which dash would cause."""
    script = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(_call([str(python_of(venv)), "-c", script], "The new environment does not start").strip())
    write_text(site / "microstereo.pth", os.path.relpath(root.resolve(), site.resolve()) + "\n")  # relative: survives a move
    settings = venv / "etc" / "jupyter" / "labconfig" / "page_config.json"
    settings.parent.mkdir(parents=True, exist_ok=True)
    write_text(settings, json.dumps({"buildCheck": False, "buildAvailable": False}))


def missing_libraries(libraries: dict[str, str]) -> str:
    """One line about missing system `libraries` (shared object -> Debian package) of Open3D on Linux, or ""."""
    lacks = [package for name, package in libraries.items() if not _loads(name)] if sys.platform == "linux" else []
    if not lacks:
        return ""
    return f"Open3D cannot start here; all else runs. On Debian and Ubuntu it needs: apt-get install {' '.join(lacks)}"


def _loads(shared_object: str) -> bool:
    with contextlib.suppress(OSError):
        return ctypes.CDLL(shared_object) is not None
    return False


def _has_nvidia_gpu() -> bool:
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        return b"GPU" in subprocess.run(["nvidia-smi", "-L"], capture_output=True, timeout=20).stdout
    return False


def _check_disk(folder: Path, needed_gb: float) -> None:
    free_gb = shutil.disk_usage(folder).free / 1e9
    if free_gb < 1.3 * needed_gb:  # unpacking needs additional space
        raise Problem(f"The environment needs {1.3 * needed_gb:.0f} GB of free disk; {folder} has {free_gb:.1f} GB.")


def _call(command: list[str], failure: str, **options) -> str:
    answer = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, **options)
    if answer.returncode:
        raise Problem(f"{failure}:\n{(answer.stderr or answer.stdout).strip()[-2000:]}")
    return answer.stdout
