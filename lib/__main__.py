"""The command line: ``python3 -m lib COMMAND``.  Runs on a bare Python and moves on into ``.venv``."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

USAGE = """\
usage: python3 -m lib COMMAND [options]        (in the folder of the workbench)

  run [NOTEBOOK ...] [--profile quick|paper] [-p NAME VALUE ...]
              work through the notebooks; the report appears in runs/<date>-<profile>/index.html
  test [...]  style and tests; what follows goes to pytest
  lab  [...]  open the notebooks in JupyterLab
  bench [...] benchmarks; what follows goes to pytest
  sweep NOTEBOOK -p NAME VALUE,VALUE,... [-p ...]
              one notebook over a grid of parameters; the results appear as a table
  simulate, train, evaluate [...]
              make recordings and data sets; train the landmark detector; measure it (--help says more)
  setup       only make the environment (each command does it when it is needed)
  lock        pin the packages anew after a change of environment.toml

  --torch cpu|cuda    with any command: the build of torch (default: cuda where there is an NVIDIA GPU)
"""

#: Oldest and first unsupported Python; environment.toml says the same to other tools.
PYTHONS = ((3, 11), (3, 15))


def main(argv: list[str]) -> int:
    """Find a fitting Python and environment, then dispatch; returns the exit code."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(USAGE)
        return 0 if argv else 2
    if argv[0] not in {*COMMANDS, "setup", "lock"}:
        print(f"unknown command: {argv[0]}\n\n{USAGE}", file=sys.stderr)
        return 2
    if not PYTHONS[0] <= sys.version_info[:2] < PYTHONS[1]:
        return _use_another_python(argv)
    from lib import environment

    try:
        torch, argv = _take_torch(argv)
        if argv[0] == "lock":
            print(f"Wrote {environment.lock(upgrade='--upgrade' in argv).relative_to(ROOT)}")
            return 0
        python = environment.ensure(torch=torch)
    except environment.Problem as problem:
        print(f"\n{problem}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nStopped. Start again; a half-made environment is repaired.", file=sys.stderr)
        return 130
    if argv[0] == "setup":
        return 0
    if Path(sys.prefix).resolve() != (ROOT / ".venv").resolve():
        return _become([str(python), "-m", "lib", *argv])
    return COMMANDS[argv[0]](argv[1:]) or 0


def _take_torch(argv: list[str]) -> tuple[str | None, list[str]]:
    """Split ``--torch BUILD`` off, wherever it stands."""
    from lib.environment import TORCH_BUILDS, Problem

    for i, word in enumerate(argv):
        if word == "--torch" or word.startswith("--torch="):
            build = word[8:] if "=" in word else "".join(argv[i + 1 : i + 2])
            if build not in TORCH_BUILDS:
                raise Problem(f"--torch {build}: choose one of {', '.join(TORCH_BUILDS)}.")
            return build, argv[:i] + argv[i + (1 if "=" in word else 2) :]
    return None, argv


def _use_another_python(argv: list[str]) -> int:
    for minor in range(PYTHONS[1][1] - 1, PYTHONS[0][1] - 1, -1):
        python = shutil.which(f"python3.{minor}")
        if python:
            return _become([python, "-m", "lib", *argv])
    wanted = f"3.{PYTHONS[0][1]} to 3.{PYTHONS[1][1] - 1}"
    print(f"microstereo needs Python {wanted}; this is {sys.version.split()[0]}.", file=sys.stderr)
    return 1


def _become(command: list[str]) -> int:
    """Go on as another process (on Windows, which cannot, as a child)."""
    if os.name == "nt":
        return subprocess.call(command)
    sys.stdout.flush()
    os.execv(command[0], command)


# --- the commands, inside .venv; each imports what it needs --------------------------------------------------------


def run(argv: list[str]) -> int:
    from lib.workbench.command import main

    return main(argv)


def test(argv: list[str]) -> int:
    style = subprocess.call(
        [sys.executable, "-m", "ruff", "check", "--output-format=concise", *ruff_options(), str(ROOT)]
    )
    return _pytest(argv, failed=style)


def bench(argv: list[str]) -> int:
    return _pytest(
        [
            "--override-ini=addopts=--import-mode=importlib --strict-markers",
            "--benchmark-only",
            "--benchmark-disable-gc",
            str(ROOT / "tests" / "benchmarks"),
            *argv,
        ]
    )


def lab(argv: list[str]) -> int:
    root = ["--allow-root"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    command = [sys.executable, "-m", "jupyterlab", f"--notebook-dir={ROOT}", "--LabApp.default_url=/lab/tree/notebooks"]
    return _become([*command, *root, *argv])


def sweep(argv: list[str]) -> int:
    from lib.workbench.sweep import main

    return main(argv)


def simulate(argv: list[str]) -> int:
    from lib.simulator.dataset import main

    return main(argv)


def train(argv: list[str]) -> int:
    from lib.training.command import main

    return main(argv)


def evaluate(argv: list[str]) -> int:
    from lib.training.command import main_evaluate as main

    return main(argv)


def _pytest(argv: list[str], failed: int = 0) -> int:
    options = ["-c", str(ROOT / "environment.toml"), f"--rootdir={ROOT}"]
    command = [sys.executable, "-m", "pytest", *options, *argv]
    return (subprocess.call(command) or failed) if failed else _become(command)


def ruff_options() -> list[str]:
    """[tool.ruff] of environment.toml as command-line options (ruff reads only files of its own names)."""
    import json

    from lib.environment import manifest

    def toml(value: object) -> str:
        if isinstance(value, dict):
            return "{" + ", ".join(f"{json.dumps(key)} = {toml(item)}" for key, item in value.items()) + "}"
        return json.dumps(value)

    return ["--isolated", *(f"--config={key} = {toml(value)}" for key, value in manifest()["tool"]["ruff"].items())]


COMMANDS = {command.__name__: command for command in (run, test, lab, bench, sweep, simulate, train, evaluate)}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
