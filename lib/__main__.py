"""The command line: ``python3 -m lib COMMAND``.  Starts on a bare Python, then continues with the Python of ``.venv``."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import shutil
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

USAGE = (ROOT / "lib" / "usage.txt").read_text(encoding="utf-8")

#: Oldest supported and first unsupported Python; environment.toml states the same for other tools.
PYTHONS = ((3, 11), (3, 15))


def main(argv: list[str]) -> int:
    """Find a supported Python, set up the environment, and run the command; returns the exit code."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(f"usage: {USAGE}")
        return 0 if argv else 2
    if argv[0] not in {*COMMANDS, "setup", "lock"}:
        print(f"unknown command: {argv[0]}\n\nusage: {USAGE}", file=sys.stderr)
        return 2
    if not PYTHONS[0] <= sys.version_info[:2] < PYTHONS[1]:
        return _use_another_python(argv)
    from lib import environment

    parser = argparse.ArgumentParser("python3 -m lib", USAGE, add_help=argv[0] not in COMMANDS, allow_abbrev=False)
    parser.add_argument("--torch", choices=environment.TORCH_BUILDS)
    options, argv = parser.parse_known_args(argv)
    if argv[0] not in COMMANDS and argv not in (["setup"], ["lock"], ["lock", "--upgrade"]):
        parser.error(f"{argv[0]}: it takes no {' '.join(argv[1:])}")
    try:
        if argv[0] == "lock":
            print(f"Wrote {environment.lock(upgrade='--upgrade' in argv).relative_to(ROOT)}")
            return 0
        python = environment.ensure(torch=options.torch)
    except (environment.Problem, OSError) as problem:
        print(f"\n{problem}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nStopped. Start again; an incomplete environment is repaired.", file=sys.stderr)
        return 130
    if argv[0] == "setup":
        return 0
    if Path(sys.prefix).resolve() != (ROOT / ".venv").resolve():
        return _become([str(python), "-m", "lib", *argv])
    return COMMANDS[argv[0]](argv[1:]) or 0


def _use_another_python(argv: list[str]) -> int:
    for minor in range(PYTHONS[1][1] - 1, PYTHONS[0][1] - 1, -1):
        python = shutil.which(f"python3.{minor}")
        if python and not subprocess.run([python, "-c", ""], capture_output=True).returncode:  # not a version manager's stub
            return _become([python, "-m", "lib", *argv])
    wanted = f"3.{PYTHONS[0][1]} to 3.{PYTHONS[1][1] - 1}"
    print(f"microstereo needs Python {wanted}; this is {sys.version.split()[0]}.", file=sys.stderr)
    return 1


def _become(command: list[str]) -> int:
    """Replace this process by `command`; on Windows, which cannot do that, run it as a child process."""
    if os.name == "nt":
        return subprocess.call(command)
    sys.stdout.flush()
    os.execv(command[0], command)


def test(argv: list[str]) -> int:
    """Check the style, then run the tests; `argv` goes to pytest."""
    from lib.parallel import cores

    style = subprocess.call([sys.executable, "-m", "ruff", "check", "--output-format=concise", *ruff_options(), ROOT])
    workers = f"--numprocesses={cores() + 1}"  # one more than cores, since some tests wait for processes
    plugins = ["-p", "xdist", "-p", "hypothesispytest"]
    return _pytest([*plugins, workers, "--dist=loadfile", "--no-loadscope-reorder", *argv]) or style


def bench(argv: list[str]) -> int:
    """Run the benchmarks in tests/benchmarks."""
    plain = ["--override-ini=addopts=--import-mode=importlib --strict-markers", "-p", "benchmark"]
    return _pytest([*plain, "--benchmark-only", "--benchmark-disable-gc", str(ROOT / "tests" / "benchmarks"), *argv])


def lab(argv: list[str]) -> int:
    """Open JupyterLab in this environment."""
    root = ["--allow-root"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    page = [] if "LabApp.default_url" in " ".join(argv) else ["--LabApp.default_url=/lab/tree/notebooks"]  # it takes only one
    return _become([sys.executable, "-m", "jupyterlab", f"--notebook-dir={ROOT}", *page, *root, *argv])


def _pytest(argv: list[str]) -> int:
    keep = {f"MALLOC_{name}_THRESHOLD_": str(1 << 30) for name in ("TRIM", "MMAP")}  # arrays reuse freed memory
    keep["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # loading every installed plugin takes time
    command = [sys.executable, "-m", "pytest", "-c", ROOT / "environment.toml", f"--rootdir={ROOT}", *argv]
    environ = keep | os.environ
    environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else each worker compiles all tests anew: seconds
    return subprocess.call(command, env=environ)


def _call(name: str, argv: list[str]) -> int:
    """Run the command `name` of `FUNCTIONS`.  Errors that a user can fix are printed in one line, without a traceback."""
    module, function = FUNCTIONS[name]
    usual = warnings.formatwarning
    warnings.formatwarning = lambda message, kind, *place, **line: (  # the line of code does not help a user
        f"Warning: {message}\n" if kind is UserWarning else usual(message, kind, *place, **line)
    )
    try:
        if module in ("lib.commands", "lib.trust.check", "lib.adapt.report"):  # these detect landmarks in a recording
            _keep_detections()
        return getattr(importlib.import_module(module), function)(argv)
    except KeyboardInterrupt:
        print("\nStopped; start again to go on.", file=sys.stderr)
        return 130
    except (OSError, ValueError) as error:
        print(f"python3 -m lib {name}: {error}", file=sys.stderr)
        return 2


def _keep_detections() -> None:
    """Name the folder in which `SharedDetector` keeps detections for later commands; other detector code has its own."""
    from lib import files, paths

    code = [*sorted((ROOT / "lib" / "landmarks").glob("*.py")), ROOT / "lib" / "recordings" / "ground.py"]
    folder = paths.CACHE / "detections" / files.digest(*code)
    with contextlib.suppress(OSError):  # on a full disk detections are not kept
        folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault(paths.SHARED_VARIABLE, str(folder))


def ruff_options() -> list[str]:
    """[tool.ruff] of environment.toml as command-line options, since ruff only reads files with certain names."""
    from lib.environment import manifest
    from lib.files import toml_entries

    return ["--isolated", *(f"--config={entry}" for entry in toml_entries(manifest()["tool"]["ruff"]))]


#: Command -> module and name of the function that it calls.
FUNCTIONS = {
    "run": ("lib.workbench.command", "main"),
    "site": ("lib.workbench.command", "main_site"),
    **{name: ("lib.commands", f"main_{name}") for name in "import annotate detect calibrate reconstruct register".split()},
    "check": ("lib.trust.check", "main"),
    "sweep": ("lib.workbench.sweep", "main"),
    "simulate": ("lib.simulator.dataset", "main"),
    "online": ("lib.online.command", "main"),
    "train": ("lib.training.command", "main"),
    "evaluate": ("lib.training.command", "main_evaluate"),
    "adapt": ("lib.adapt.report", "main"),
}
COMMANDS = {"test": test, "bench": bench, "lab": lab, **{name: partial(_call, name) for name in FUNCTIONS}}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
