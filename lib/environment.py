"""Makes and checks ``.venv``: the environment that every command of the workbench runs in.

Standard library only, since it runs on a bare Python.  `ensure` compares a stamp, written when the environment was
complete, with environment.toml and its lock; where they agree nothing else is done.  A half-made environment has no
such stamp and is made anew.  One process makes it while others wait.
"""

from __future__ import annotations

import ast
import contextlib
import ctypes
import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

__all__ = ["Problem", "ensure", "lock", "manifest", "python_of"]

ROOT = Path(__file__).resolve().parent.parent
TORCH_BUILDS = ("cpu", "cuda")
_STAMP = "microstereo.json"
#: What the lock leaves out: torch and the CUDA packages that only its default Linux build asks for.
_TORCH_PACKAGES = re.compile(r"(torch|triton|nvidia-.*|cuda-.*)")


class Problem(Exception):
    """The environment cannot be made; the text says why and what to type."""


def manifest(root: Path = ROOT) -> dict:
    """The parsed ``environment.toml``."""
    import tomllib  # not at the top: the launcher must reach its friendly word on an older Python

    return tomllib.loads((root / "environment.toml").read_text(encoding="utf-8"))


def python_of(venv: Path) -> Path:
    """The interpreter of a virtual environment."""
    return venv / "Scripts" / "python.exe" if os.name == "nt" else venv / "bin" / "python"


def ensure(root: Path = ROOT, torch: str | None = None) -> Path:
    """The interpreter of a complete ``.venv``, made, repaired or brought up to date first where need be.

    Parameters
    ----------
    root:
        Folder of environment.toml; ``.venv`` lies in it.
    torch:
        ``"cpu"`` or ``"cuda"``; None keeps the build that is installed, or picks by whether there is an NVIDIA GPU.

    Raises
    ------
    Problem
        If it cannot be made: too old a Python, missing system libraries, disk or network.
    """
    venv = root / ".venv"
    if not _is_ready(root, torch):
        with _sole_maker(root) as lock_file:
            if not _is_ready(root, torch):  # another process may have made it meanwhile
                _make(root, venv, torch, lock_file)
    return python_of(venv)


def lock(root: Path = ROOT, *, upgrade: bool = False) -> Path:
    """Write the lock anew from environment.toml: each package, for each platform, with hashes and no host.

    Pins that still fit are kept unless `upgrade` is given.  Needs uv (``pip install uv``) and the network.
    """
    uv = shutil.which("uv")
    if not uv:
        raise Problem("Writing the lock needs uv: python3 -m pip install uv")
    workbench = manifest(root)["tool"]["workbench"]
    path = root / workbench["lock"]
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(root / "environment.toml", Path(folder) / "pyproject.toml")
        if path.exists() and not upgrade:
            shutil.copy(path, Path(folder) / "lock.txt")
        groups = [f"--group={group}" for group in workbench["groups"]]
        options = ["--universal", "--generate-hashes", "--no-annotate", "--no-header", "--quiet", "-o", "lock.txt"]
        _call([uv, "pip", "compile", "pyproject.toml", *groups, *options], "Resolving failed", cwd=folder)
        text = (Path(folder) / "lock.txt").read_text(encoding="utf-8")
    blocks = re.split(r"\n(?=[a-zA-Z0-9])", text.strip())
    blocks = [block for block in blocks if not _TORCH_PACKAGES.fullmatch(block.split("==")[0])]
    header = "# Made by `python3 -m lib lock` from environment.toml; torch comes by build and is not in here.\n"
    _write(path, header + "\n".join(blocks) + "\n")
    return path


# --- is it there? -------------------------------------------------------------------------------------------------


def _digest(root: Path) -> str:
    files = [root / "environment.toml", root / "lib" / "environment.lock"]
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()


def _read_stamp(venv: Path) -> dict:
    """{} where there is none; {"state": "making"} where the environment is half made."""
    try:
        return json.loads((venv / _STAMP).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _is_ready(root: Path, torch: str | None) -> bool:
    venv = root / ".venv"
    stamp = _read_stamp(venv)
    return (
        stamp.get("state") == "ready"
        and stamp["digest"] == _digest(root)
        and torch in (None, stamp["torch"])
        and python_of(venv).exists()  # False for a link to an interpreter that has gone
    )


@contextlib.contextmanager
def _sole_maker(root: Path):
    """Hold a lock while making the environment.

    The installer inherits it: if this process is killed, the next one waits until the orphan has ended.
    """
    with open(root / "lib" / "environment.lock", "rb") as file:
        try:
            if os.name == "nt":
                import msvcrt

                file.seek(1 << 30)  # a byte that no reader of the lock meets

                def take():
                    msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                def take():
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

            waiting = False
            while True:
                try:
                    take()
                    break
                except (BlockingIOError, PermissionError):
                    if not waiting:
                        _say("Another process is setting up the environment; waiting for it ...")
                    waiting = True
                    time.sleep(0.5)
        except OSError:
            pass  # a file system without locks: go on alone
        yield file


# --- making it ----------------------------------------------------------------------------------------------------


def _make(root: Path, venv: Path, torch: str | None, lock_file) -> None:
    workbench = manifest(root)["tool"]["workbench"]
    check_system(workbench["system_libraries"])
    stamp = _read_stamp(venv)
    if venv.exists() and not stamp and any(venv.iterdir()):
        raise Problem(f"{venv} was not made by microstereo; move it away and start again.")
    torch = torch or stamp.get("torch") or ("cuda" if _has_nvidia_gpu() else "cpu")
    if torch not in TORCH_BUILDS:
        raise Problem(f"--torch {torch}: choose one of {', '.join(TORCH_BUILDS)}.")
    update = stamp.get("state") == "ready" and python_of(venv).exists()
    if not update:
        shutil.rmtree(venv, ignore_errors=True)
        _check_disk(root, workbench["disk_gb"][torch])
    uv = shutil.which("uv")
    _say(
        f"{'Updating' if update else 'Making'} the environment in .venv with {'uv' if uv else 'pip'}, "
        f"torch for {torch}. Once; takes {'a minute' if uv else '1 to 5 minutes'}, {workbench['disk_gb'][torch]} GB "
        f"of disk and up to {workbench['download_gb'][torch]} GB of download."
    )
    start = time.monotonic()
    venv.mkdir(exist_ok=True)
    _write(venv / _STAMP, json.dumps({"state": "making", "torch": torch}))
    if not update:
        _make_venv(venv, uv)
    install = _Installer(venv, uv, lock_file)
    install(
        "packages",
        ["--require-hashes", "--no-deps", "-r", str(root / workbench["lock"])],
        total=_count_locked(root / workbench["lock"]),
    )
    _install_torch(install, root, workbench["torch"], torch)
    _write_site_files(root, venv)
    _write(venv / _STAMP, json.dumps({"state": "ready", "digest": _digest(root), "torch": torch}))
    _say(f"The environment is ready after {time.monotonic() - start:.0f} s.")


def _make_venv(venv: Path, uv: str | None) -> None:
    """An empty environment with pip in it, from the interpreter that runs this."""
    interpreter = getattr(sys, "_base_executable", sys.executable)
    if not _makes_environments():
        command = [str(uv), "venv", "--quiet", "--seed", "--allow-existing", "--python", interpreter, str(venv)]
        _call(command, "uv could not make the virtual environment")
        return
    _call([interpreter, "-m", "venv", str(venv)], "Python could not make the virtual environment")


class _Installer:
    """Installs into the environment with uv or pip, shows how far it is, and keeps the log for a failure."""

    def __init__(self, venv: Path, uv: str | None, lock_file):
        self.venv, self.uv, self.lock_file = venv, uv, lock_file
        self.python = str(python_of(venv))

    def command(self, arguments: list[str]) -> list[str]:
        if self.uv:
            arguments = [*_uv_sources(_pip_configuration(self.python)), *arguments]
            return [self.uv, "pip", "install", "--python", self.python, *arguments]
        quiet = ["--disable-pip-version-check", "--no-input", "--no-compile", "--progress-bar=off"]
        return [self.python, "-m", "pip", "install", *quiet, *arguments]

    def __call__(self, what: str, arguments: list[str], *, total: int = 0) -> None:
        log: list[str] = []
        keep_lock = {} if os.name == "nt" else {"pass_fds": [self.lock_file.fileno()]}
        process = subprocess.Popen(
            self.command(arguments),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
            **keep_lock,
        )
        seen, shown = 0, 0.0
        try:
            for line in process.stdout:
                log.append(line.rstrip())
                seen += line.startswith("Collecting ")
                finishing = line.startswith("Installing collected")
                if finishing or (total and seen and time.monotonic() - shown > (0.2 if sys.stdout.isatty() else 15)):
                    shown = time.monotonic()
                    name = line.split()[1].split("==")[0] if line.startswith("Collecting ") else ""
                    _progress(f"  {what}: unpacking ..." if finishing else f"  {what}: {seen} of about {total} {name}")
            code = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
        finally:
            if sys.stdout.isatty():
                print("\r\033[K", end="")
        if code:
            tail = "\n".join("    " + line for line in log[-15:])
            raise Problem(f"Installing {what} failed:\n{tail}\nCheck the network, then start again.")


def _install_torch(install: _Installer, root: Path, indexes: dict, build: str) -> None:
    attempts = torch_attempts(_torch_version(root), build, sys.platform, indexes)
    for number, arguments in enumerate(attempts, start=1):
        try:
            install(f"torch ({build})", arguments)
            return
        except Problem as problem:
            if number == len(attempts):
                hint = ""
                if build == "cpu" and sys.platform == "linux":
                    hint = "\nNo CPU build could be had; --torch cuda installs the default build, which is far larger."
                raise Problem(f"{problem}{hint}") from None


def torch_attempts(version: str, build: str, platform: str, indexes: dict) -> list[list[str]]:
    """Installer arguments to try in turn for a build of torch; the lock already holds what the CPU build needs."""
    if build == "cuda":
        if platform == "darwin":
            raise Problem("--torch cuda: there is no CUDA on a Mac; leave the option out.")
        if platform == "win32":
            return [["--index-url", indexes["windows_cuda_index"], f"torch=={version}"]]
        return [[f"torch=={version},!={version}+cpu"]]
    if platform == "linux":
        return [
            ["--no-deps", f"torch=={version}+cpu"],  # where the machine's own package sources hold it
            ["--no-deps", "--index-url", indexes["cpu_index"], f"torch=={version}"],
        ]
    return [["--no-deps", f"torch=={version}"]]


def _write_site_files(root: Path, venv: Path) -> None:
    """`import lib` from any folder and kernel; no build dialog in JupyterLab (dash ships an extension's source)."""
    script = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(_call([str(python_of(venv)), "-c", script], "The new environment does not start").strip())
    _write(site / "microstereo.pth", os.path.relpath(root.resolve(), site.resolve()) + "\n")  # survives a move
    settings = venv / "etc" / "jupyter" / "labconfig" / "page_config.json"
    settings.parent.mkdir(parents=True, exist_ok=True)
    _write(settings, json.dumps({"buildCheck": False, "buildAvailable": False}))


# --- what the machine has -----------------------------------------------------------------------------------------


def check_system(libraries: dict[str, str], *, loads=None, install=None) -> None:
    """See that what no wheel brings is there; install it as root or with password-less sudo where apt is.

    That is Open3D's system libraries on Linux, and the part of Python that makes virtual environments, which
    Debian and Ubuntu pack apart.

    Parameters
    ----------
    libraries:
        Shared object -> Debian package.
    loads, install:
        Replaced by tests: does a shared object load; run apt for packages and say whether it went well.

    Raises
    ------
    Problem
        With the one line to type.
    """
    loads, install = loads or _loads, install or _apt_install

    def missing() -> dict[str, str]:
        found = {}
        if sys.platform.startswith("linux"):
            found = {name: package for name, package in libraries.items() if not loads(name)}
        if not _makes_environments() and not shutil.which("uv"):
            found["ensurepip"] = f"python{sys.version_info[0]}.{sys.version_info[1]}-venv"
        return found

    lacks = missing()
    if not lacks:
        return
    _say(f"The system lacks {', '.join(lacks)} (needed by Open3D and by virtual environments).")
    if install(list(lacks.values())) and not missing():
        return
    if shutil.which("apt-get"):
        raise Problem(f"Type this, then start again:\n    sudo apt-get install -y {' '.join(lacks.values())}")
    raise Problem(
        f"Install what brings {', '.join(lacks)}, then start again. On Fedora:\n"
        "    sudo dnf install mesa-libEGL mesa-libGL libusb1 python3-pip"
    )


def _makes_environments() -> bool:
    importlib.invalidate_caches()
    return importlib.util.find_spec("ensurepip") is not None


def _loads(shared_object: str) -> bool:
    try:
        ctypes.CDLL(shared_object)
    except OSError:
        return False
    return True


def _apt_install(packages: list[str]) -> bool:
    """True if apt installed them; False where there is no apt, or no right to use it without a password."""
    apt = shutil.which("apt-get")
    if not apt:
        return False
    prefix: list[str] = []
    if os.geteuid() != 0:
        sudo = shutil.which("sudo")
        if not sudo or subprocess.run([sudo, "-n", "true"], capture_output=True).returncode:
            return False
        prefix = [sudo, "-n"]
    _say(f"Installing them with apt: {' '.join(packages)}")
    command = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", apt]
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    install = [*command, "install", "-y", "--no-install-recommends", *packages]
    if subprocess.run(install, **quiet).returncode == 0:
        return True
    subprocess.run([*command, "update"], **quiet)  # a fresh image has no package lists
    return subprocess.run(install, **quiet).returncode == 0


def _has_nvidia_gpu() -> bool:
    tool = shutil.which("nvidia-smi")
    if not tool:
        return False
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        return b"GPU" in subprocess.run([tool, "-L"], capture_output=True, timeout=20).stdout
    return False


def _check_disk(folder: Path, needed_gb: float) -> None:
    free_gb = shutil.disk_usage(folder).free / 1e9
    if free_gb < 1.3 * needed_gb:  # unpacking needs room of its own
        raise Problem(f"The environment needs {1.3 * needed_gb:.0f} GB of free disk; {folder} has {free_gb:.1f} GB.")


def _pip_configuration(python: str) -> dict[str, str]:
    """What pip is told by its files and environment variables, such as {"find-links": ...}; uv reads none of it."""
    answer = subprocess.run([python, "-m", "pip", "config", "list"], capture_output=True, text=True)
    found: dict[str, dict[str, str]] = {"global": {}, "install": {}, ":env:": {}}
    for line in answer.stdout.splitlines():
        section, _, rest = line.partition(".")
        key, _, value = rest.partition("=")
        if section in found:
            with contextlib.suppress(ValueError, SyntaxError):
                found[section][key] = ast.literal_eval(value)
    return {**found["global"], **found["install"], **found[":env:"]}


def _uv_sources(configuration: dict[str, str]) -> list[str]:
    """The same package sources in uv's words."""
    options = {
        "index-url": "--default-index",
        "extra-index-url": "--index",
        "find-links": "--find-links",
        "trusted-host": "--allow-insecure-host",
    }
    arguments = []
    for key, option in options.items():
        for value in configuration.get(key, "").split():
            arguments += [option, value]
    if "extra-index-url" in configuration:
        arguments += ["--index-strategy", "unsafe-best-match"]  # pip's rule: the best version of all sources
    return arguments


# --- small things -------------------------------------------------------------------------------------------------


def _torch_version(root: Path) -> str:
    pins = manifest(root)["project"]["dependencies"]
    return next(pin.split("==")[1] for pin in pins if pin.startswith("torch=="))


def _count_locked(lock_file: Path) -> int:
    return sum(line[:1].isalnum() for line in lock_file.read_text(encoding="utf-8").splitlines())


def _call(command: list[str], failure: str, **options) -> str:
    answer = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, **options)
    if answer.returncode:
        raise Problem(f"{failure}:\n{(answer.stderr or answer.stdout).strip()[-2000:]}")
    return answer.stdout


def _write(path: Path, text: str) -> None:
    """Whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def _say(text: str) -> None:
    print(text, flush=True)


def _progress(text: str) -> None:
    if sys.stdout.isatty():
        print(f"\r\033[K{text}", end="", flush=True)
    else:
        print(text, flush=True)
