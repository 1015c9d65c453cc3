"""The command line, without running what it starts."""

from __future__ import annotations

import ast
import importlib
import os
import warnings
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import pytest

from lib import __main__ as command_line
from lib import environment, paths


@pytest.fixture
def inside(monkeypatch):
    """As in the finished environment: nothing is installed, nothing is executed anew."""
    monkeypatch.setattr(environment, "ensure", lambda torch=None: Path("python"))
    monkeypatch.setattr(command_line.sys, "prefix", str(paths.ROOT / ".venv"))


def test_help_names_every_command(capsys):
    assert command_line.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(command in text for command in command_line.COMMANDS)


@pytest.mark.parametrize("argv", [[], ["rum"]])
def test_unknown_command_is_an_error(argv, capsys):
    assert command_line.main(argv) == 2


def test_commands_get_what_follows_them(inside, monkeypatch):
    monkeypatch.setitem(command_line.COMMANDS, "run", lambda argv: argv)
    assert command_line.main(["run", "03", "--profile", "paper"]) == ["03", "--profile", "paper"]
    assert command_line.main(["run", "03", "--torch", "cpu", "-p", "seed", "1"]) == ["03", "-p", "seed", "1"]
    assert command_line.main(["run", "--torch=cuda", "03"]) == ["03"]


def test_the_torch_build_reaches_the_environment(inside, monkeypatch):
    asked = []
    monkeypatch.setattr(environment, "ensure", lambda torch=None: asked.append(torch) or Path("python"))
    monkeypatch.setitem(command_line.COMMANDS, "run", lambda argv: 0)
    command_line.main(["run", "--torch", "cuda"])
    command_line.main(["run"])
    assert asked == ["cuda", None]


def test_an_unknown_torch_build_is_an_error(inside, capsys):
    with pytest.raises(SystemExit) as stop:
        command_line.main(["run", "--torch", "rocm"])
    assert stop.value.code == 2 and "invalid choice: 'rocm'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "code"),
    [(["lock", "--help"], 0), (["setup", "-h"], 0), (["setup", "--torhc", "cuda"], 2), (["lock", "torch"], 2),
     (["setup", "--upgrade"], 2)],
)  # fmt: skip
def test_setup_and_lock_do_nothing_but_what_they_are_asked(argv, code, monkeypatch, capsys):
    monkeypatch.setattr(environment, "ensure", None)
    monkeypatch.setattr(environment, "lock", None)
    with pytest.raises(SystemExit) as stop:
        command_line.main(argv)
    said = capsys.readouterr()
    assert stop.value.code == code and ("it takes no" in said.err if code else "pin the packages anew" in said.out)


def test_lock_upgrades_on_request(monkeypatch):
    asked = []
    monkeypatch.setattr(environment, "lock", lambda upgrade: asked.append(upgrade) or command_line.ROOT / "a.lock")
    assert command_line.main(["lock"]) == command_line.main(["lock", "--upgrade"]) == 0 and asked == [False, True]


@pytest.mark.parametrize("command", ["check", "sweep"])
def test_commands_that_detect_keep_their_detections_for_the_next_one(command, monkeypatch, tmp_path):
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    monkeypatch.setenv(paths.SHARED_VARIABLE, "")
    monkeypatch.delenv(paths.SHARED_VARIABLE)
    module, function = command_line.FUNCTIONS[command]
    monkeypatch.setattr(importlib.import_module(module), function, lambda argv: os.environ.get(paths.SHARED_VARIABLE))
    folder = command_line.COMMANDS[command]([])
    kept = [str(path) for path in tmp_path.glob("detections/*")]
    assert kept == ([folder] if command == "check" else [])


@pytest.mark.parametrize(("module", "function"), command_line.FUNCTIONS.values())
def test_every_command_has_its_function(module, function):
    source = (paths.ROOT / Path(*module.split("."))).with_suffix(".py").read_text(encoding="utf-8")
    assert any(getattr(node, "name", "") == function for node in ast.parse(source).body)


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (ValueError("frames: 0; give at least 3."), 2, "python3 -m lib run: frames: 0; give at least 3."),
        (OSError(28, "No space left on device", "a.png"), 2, "No space left on device: 'a.png'"),
        (KeyboardInterrupt(), 130, "start again to go on"),
    ],
)
def test_what_a_user_can_mend_is_told_in_one_line(inside, monkeypatch, capsys, error, code, text):
    def fails(argv):
        raise error

    monkeypatch.setattr(command_line.importlib, "import_module", lambda name: SimpleNamespace(main=fails))
    assert command_line.main(["run"]) == code
    said = capsys.readouterr().err
    assert text in said and len(said.strip().splitlines()) == 1


def test_a_warning_is_told_without_the_line_of_code(inside, monkeypatch, capsys):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    monkeypatch.setattr(warnings, "showwarning", lambda *one: print(warnings.formatwarning(*one), end=""))
    main = SimpleNamespace(main=lambda argv: warnings.warn("my eye: the log is short.", stacklevel=1))
    monkeypatch.setattr(command_line.importlib, "import_module", lambda name: main)
    assert command_line.main(["run"]) == 0
    assert capsys.readouterr().out == "Warning: my eye: the log is short.\n"


def test_a_problem_of_the_environment_is_told_without_traceback(monkeypatch, capsys):
    def fail(torch=None):
        raise environment.Problem("sudo apt-get install it")

    monkeypatch.setattr(environment, "ensure", fail)
    assert command_line.main(["run"]) == 1
    assert capsys.readouterr().err == "\nsudo apt-get install it\n"


def test_outside_the_environment_it_becomes_its_python(monkeypatch):
    monkeypatch.setattr(environment, "ensure", lambda torch=None: Path("/x/.venv/bin/python"))
    monkeypatch.setattr(command_line.sys, "prefix", "/usr")
    monkeypatch.setattr(command_line, "_become", lambda command: command)
    assert command_line.main(["test", "-k", "x"]) == ["/x/.venv/bin/python", "-m", "lib", "test", "-k", "x"]


def test_lab_opens_the_notebooks_or_the_page_that_it_is_given(inside, monkeypatch):
    """JupyterLab refuses two addresses with a traceback, and opens neither."""
    monkeypatch.setattr(command_line, "_become", lambda command: [word for word in command if "default_url" in word])
    given = "--LabApp.default_url=/lab/tree/runs/annotate-mine.ipynb"
    assert command_line.main(["lab", "--no-browser"]) == ["--LabApp.default_url=/lab/tree/notebooks"]
    assert command_line.main(["lab", given]) == [given]


VersionInfo = namedtuple("VersionInfo", "major minor micro releaselevel serial")


@pytest.mark.parametrize("version", [(3, 9), (3, 15)])
def test_an_unfit_python_uses_a_fitting_one_or_says_so(version, monkeypatch, capsys):
    monkeypatch.setattr(command_line.sys, "version_info", VersionInfo(*version, 0, "final", 0))
    monkeypatch.setattr(command_line, "_become", lambda command: command)
    monkeypatch.setattr(command_line.shutil, "which", lambda name: f"/bin/{name}" if name < "python3.14" else None)
    stub = "/bin/python3.13"  # as of pyenv, which knows the version and does not run it here
    monkeypatch.setattr(command_line.subprocess, "run", lambda words, **_: SimpleNamespace(returncode=words[0] == stub))
    assert command_line.main(["run"]) == ["/bin/python3.12", "-m", "lib", "run"]
    monkeypatch.setattr(command_line.shutil, "which", lambda name: None)
    assert command_line.main(["run"]) == 1
    assert "needs Python 3.11 to 3.14" in capsys.readouterr().err


@pytest.mark.parametrize("module", ["__init__.py", "__main__.py", "environment.py"])
def test_the_launcher_parses_on_an_old_python(module):
    """Else it could not say that the Python is too old."""
    ast.parse((paths.ROOT / "lib" / module).read_text(encoding="utf-8"), feature_version=(3, 7))


def test_supported_pythons_agree_with_environment_toml():
    (low, high) = command_line.PYTHONS
    wanted = f">={low[0]}.{low[1]},<{high[0]}.{high[1]}"
    assert environment.manifest()["project"]["requires-python"] == wanted


def test_ruff_is_told_what_environment_toml_says():
    options = command_line.ruff_options()
    assert "--config=line-length = 120" in options
    assert any(option.startswith('--config=lint = { select = ["E"') for option in options)
