"""``python3 -m lib run``: executes the notebooks, several at once, and updates the report after each."""

import argparse
import contextlib
import datetime
import itertools
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from tqdm.auto import tqdm

from lib import files, paths
from lib.parallel import cores, lives
from lib.provenance import commit, machine
from lib.workbench import execution, pages
from lib.workbench.execution import Failure, execute

#: A file that reserves space, so that a run can write its last state when the disk is full.
_ROOM = ".room"
#: The most notebooks that run at once if the command does not say how many; one may need 4 GB of memory.
_AT_ONCE = 4


def main(argv: Sequence[str]) -> int:
    """Parse the command line and run: 0 if every notebook completed, 1 if one failed, 128 + n for signal n."""
    parser = argparse.ArgumentParser("python3 -m lib run", description="Execute notebooks; report in runs/<date>-<profile>/.")
    add = parser.add_argument
    add("notebooks", nargs="*", metavar="NOTEBOOK", help="path, name or number (default: all)")
    add("--profile", choices=("quick", "paper"), default="quick", help="quick: minutes; paper: the paper's sizes")
    add("-p", dest="pairs", nargs=2, action="append", default=[], metavar=("NAME", "VALUE"), help="set a declared parameter")
    add("--cell-timeout", type=execution.positive, metavar="S", help="longest time of one cell (default: 900 for quick)")
    add("--jobs", type=int, metavar="N", help=f"notebooks at once (default: one for each core, at most {_AT_ONCE})")
    add("--runs", type=Path, default=paths.RUNS, metavar="FOLDER", help="folder for the run's folder")
    options = parser.parse_args(argv)
    timeout = options.cell_timeout or (900.0 if options.profile == "quick" else None)
    received = []

    def stop(number, frame):
        received.append(number)
        raise KeyboardInterrupt

    for name in ("SIGTERM", "SIGHUP"):  # as with Ctrl-C, the report then states that the run was stopped
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:  # nohup ignores one
            signal.signal(getattr(signal, name), stop)
    names, profile, pairs = options.notebooks, options.profile, options.pairs
    result = run(names, profile, pairs, cell_timeout_s=timeout, jobs=options.jobs, runs=options.runs)
    return {"complete": 0, "failed": 1, "stopped": 128 + (received or [signal.SIGINT])[0]}[result["state"]]


def main_site(argv: Sequence[str]) -> int:
    """Copy a run into a folder that a web server can serve unchanged."""
    parser = argparse.ArgumentParser("python3 -m lib site", description="Make a static site of a run, for GitHub Pages.")
    parser.add_argument("run", nargs="?", type=Path, metavar="RUN", help="its folder (default: the last complete run)")
    parser.add_argument("--out", type=Path, default=paths.ROOT / "site", metavar="FOLDER", help="a new folder")
    options = parser.parse_args(argv)
    chosen = options.run or next((folder for folder, _ in reversed(complete_runs(paths.RUNS))), paths.RUNS)
    if not (chosen / "index.html").is_file():
        raise FileNotFoundError(f"{chosen}: no run with an index.html; `python3 -m lib run` makes one.")
    if options.out.exists() or not options.out.absolute().parent.is_dir():
        raise OSError(f"{options.out}: it exists already, or the folder for it does not; name another with --out.")
    with tempfile.TemporaryDirectory(prefix="site-", dir=options.out.absolute().parent) as made:  # no half site may appear
        (shutil.copytree(chosen, Path(made) / "site") / ".nojekyll").touch()  # makes GitHub Pages serve every file unchanged
        (Path(made) / "site").rename(options.out)
    print(f"Site: {options.out / 'index.html'}")
    return 0


def run(
    names: Sequence[str] = (), profile: str = "quick", pairs: Sequence[tuple[str, str]] = (), *,
    cell_timeout_s: float | None = None, jobs: int | None = None, runs: Path = paths.RUNS, notebooks: Path = paths.NOTEBOOKS,
) -> dict:  # fmt: skip
    """Execute notebooks, `jobs` at once, into a new folder of `runs`, and return the content of its metrics.json.

    While a cell that is tagged `lib.workbench.execution.ALONE` runs, the other notebooks wait.  If a notebook fails, the
    others still run.  The report is written after each, so a killed run leaves a readable one.  Before anything runs, an
    unknown notebook or parameter and a wrong value are a ValueError, a missing recording is a FileNotFoundError.  A later
    OSError means that the report cannot be written; its state is then "failed", if that can still be written.
    """
    chosen = execution.choose_notebooks(names, notebooks)
    if any(name == "profile" for name, _ in pairs):
        raise ValueError("parameter profile: give it as --profile.")
    values = execution.parse_parameters(pairs, chosen, profile)
    if (folder := dict(pairs).get("recording")) and not (Path(folder) / "recording.toml").is_file():
        raise FileNotFoundError(f"parameter recording: {folder} has no recording.toml. Give the folder of a recording.")
    jobs = min(cores(), _AT_ONCE) if jobs is None else jobs
    if jobs < 1:
        raise ValueError(f"jobs: {jobs} notebooks at once; give at least 1.")
    report = _Report(_new_folder(runs, profile), chosen, profile, dict(pairs))
    width, places = max(len(book.stem) for book in chosen), execution.Places(jobs)

    def work(number: int) -> None:
        book, label = chosen[number], f"[{number + 1}/{len(chosen)}] {chosen[number].stem:<{width}}"
        with places.taken() as begin:
            start = time.monotonic()
            report.begin(number)
            options = {"cell_timeout_s": cell_timeout_s, "label": label, "begin": begin}
            failure = execute(book, report.folder / book.name, values[book], **options)
            if places.closed:  # the run was stopped, so it is no failure of the notebook
                return
            report.end(number, failure, seconds := time.monotonic() - start)
            with tqdm.external_write_mode():
                print(f"{label}  {seconds:6.1f} s  {'failed' if failure else 'done'}", flush=True)

    try:
        paths.CACHE.mkdir(parents=True, exist_ok=True)
        for folder in paths.CACHE.glob("run-[0-9]*-*"):  # of runs that were killed
            if not lives(int(folder.name.split("-")[1])):
                shutil.rmtree(folder, ignore_errors=True)
        with tempfile.TemporaryDirectory(prefix=f"run-{os.getpid()}-", dir=paths.CACHE, ignore_cleanup_errors=True) as shared:
            os.environ[paths.SHARED_VARIABLE] = shared  # inherited by the kernels
            with ThreadPoolExecutor(jobs) as pool:
                try:
                    for future in as_completed([pool.submit(work, number) for number in range(len(chosen))]):
                        future.result()
                except BaseException:
                    places.closed = True
                    pool.shutdown(wait=False, cancel_futures=True)
                    execution.end_kernels()
                    raise
        report.finish()
    except KeyboardInterrupt:
        report.finish("stopped")
        with contextlib.suppress(OSError):  # the terminal may be closed
            print("\nStopped.")
    except OSError as error:
        report.finish("failed")
        raise OSError(f"{error}. The run in {paths.shown(report.folder)} ends here; check its disk.") from error
    finally:
        os.environ.pop(paths.SHARED_VARIABLE, None)
    for entry in report.content["notebooks"]:
        if entry["failure"]:
            print(f"FAILED {entry['name']}: {Failure(**entry['failure'])}", file=sys.stderr)
    content = report.content
    print(f"\nReport: {report.folder / 'index.html'}")
    if content["verdict"]:
        names = ", ".join(dict.fromkeys(reason["name"].replace("_", " ") for reason in content["reasons"]))
        folder = content["parameters"].get("recording") or paths.shown(paths.SHIPPED_RECORDING)
        print(f"Verdict: {content['verdict']}" + (f" ({names}); `python3 -m lib check {folder}` says more" if names else ""))
    return content


def complete_runs(runs: Path) -> list[tuple[Path, dict]]:
    """The folders of complete runs in `runs` with their metrics.json, the last run last."""
    found = []
    for file in runs.glob("*/metrics.json"):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # written by another version, or cut off
            content = json.loads(file.read_text(encoding="utf-8"))
            if (content["format"], content["state"], type(content["started"])) == ("microstereo.metrics", "complete", str):
                found.append((file.parent, content))
    return sorted(found, key=lambda run: run[1]["started"])


def previous_values(runs: Path, content: dict) -> dict[str, float | None]:
    """Metric -> its value in the last complete run that has it, on the machine and with the settings of `content`."""
    found = {}
    for _, other in complete_runs(runs):
        with contextlib.suppress(KeyError, TypeError):  # written by another version
            alike = all(other[key] == content[key] for key in ("profile", "parameters"))
            if alike and all(other["machine"][key] == content["machine"][key] for key in ("processor", "cores", "gpu")):
                found |= {m["name"]: m["value"] for m in other["metrics"] if not pages.is_recorded(m)}
    return found


class _Report:
    """Writes the folder of a run: metrics.json with its `content`, the page of each notebook, figures and index.html."""

    def __init__(self, folder: Path, notebooks: Sequence[Path], profile: str, given: dict[str, str]):
        self.folder, self.notebooks, self.start = folder, notebooks, time.monotonic()
        self.content = {
            "format": "microstereo.metrics", "version": 1, "state": "running", "profile": profile, "parameters": given,
            "started": datetime.datetime.now().astimezone().isoformat(timespec="seconds"), "seconds": 0.0,
            "commit": commit(), "machine": machine(),
            "weights": files.digest(paths.MODELS / "default.safetensors"), "versions": execution.versions(),
            "notebooks": [
                {"name": book.stem, "title": execution.title_of(book), "state": "pending", "seconds": None, "failure": None,
                 "page": None, "executed": None, "left_out": None, "verdict": None, "reasons": []}
                for book in notebooks
            ],
            "verdict": None, "reasons": [], "metrics": [], "figures": [], "download": None,
        }  # fmt: skip
        self.content["previous"] = previous_values(folder.parent, self.content)
        self._lock = threading.Lock()  # several notebooks may begin and end at once
        (folder / "figures").mkdir()
        (folder / _ROOM).write_bytes(bytes(1 << 20))
        self.write()

    def begin(self, number: int) -> None:
        """State that a notebook runs."""
        with self._lock:
            self.content["notebooks"][number]["state"] = "running"
            self.write()

    def end(self, number: int, failure: Failure | None, seconds: float) -> None:
        """Collect what a notebook recorded, even if it failed later, and write its page."""
        with self._lock:
            self._collect(number, failure, seconds)
            self.write()

    def _collect(self, number: int, failure: Failure | None, seconds: float) -> None:
        book, content = self.notebooks[number], self.content
        entry, executed = content["notebooks"][number], self.folder / book.name
        entry |= {"state": "failed" if failure else "complete", "seconds": round(seconds, 2)}
        entry["failure"] = failure._asdict() if failure else None
        try:
            stated = execution.stated_in(executed)
        except (OSError, ValueError):  # it is missing, or a full disk has cut it off
            executed.unlink(missing_ok=True)
        else:
            entry |= {"left_out": stated.left_out} | (stated.verdict or {})
            content |= execution.joined(content["notebooks"]) or {}
            content["metrics"] += [{"notebook": book.stem, **m} for m in stated.metrics]
            for named, suffix, data in stated.figures:
                file = f"figures/{named['name']}{suffix}"
                if any(other["file"] == file for other in content["figures"]):
                    file = f"figures/{book.stem}.{named['name']}{suffix}"
                files.write_bytes(self.folder / file, data)
                content["figures"].append({"notebook": book.stem, **named, "file": file})
            before, after = ([None, *content["notebooks"], None][k] for k in (number, number + 2))
            text = pages.page(executed, book.parent, entry, previous=before, following=after)
            if pages.PLOTLY_FILE in text and not (self.folder / pages.PLOTLY_FILE).exists():
                import plotly

                shutil.copy(Path(plotly.__file__).parent / "package_data" / pages.PLOTLY_FILE, self.folder)
            files.write_text(self.folder / f"{book.stem}.html", text)
            entry |= {"page": f"{book.stem}.html", "executed": book.name}
            place = [other.stem for other in self.notebooks].index
            for found in (content["metrics"], content["figures"]):
                found.sort(key=lambda one: place(one["notebook"]))  # not in the order in which the notebooks ended

    def finish(self, state: str | None = None) -> None:
        failed = any(entry["state"] == "failed" for entry in self.content["notebooks"])
        self.content["state"] = state or ("failed" if failed else "complete")
        for entry in self.content["notebooks"]:
            if entry["state"] == "running":
                entry["state"] = "pending"
        (self.folder / _ROOM).unlink(missing_ok=True)
        self.content["download"] = None if state == "stopped" else f"{self.folder.name}.zip"
        self.write()
        if self.content["download"]:
            try:
                shutil.move(shutil.make_archive(str(self.folder), "zip", self.folder.parent, self.folder.name), self.folder)
            except OSError:  # the disk has no room for the zip
                Path(f"{self.folder}.zip").unlink(missing_ok=True)
                self.content["download"] = None
                self.write()

    def write(self) -> None:
        self.content["seconds"] = round(time.monotonic() - self.start, 2)
        files.write_text(self.folder / "index.html", pages.index_html(self.content))
        files.write_json(self.folder / "metrics.json", self.content)  # last, so that the page is never older than it


def _new_folder(runs: Path, profile: str) -> Path:
    """Make the folder ``<date>-<profile>``, or with ``-2``, ``-3``, ... if that exists: no run changes another's files."""
    runs.mkdir(parents=True, exist_ok=True)
    stem = f"{datetime.date.today().isoformat()}-{profile}"
    for number in itertools.count(1):
        folder = runs / (stem if number == 1 else f"{stem}-{number}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
