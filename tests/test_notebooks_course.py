"""What the notebooks teach: each equation worked out in a cell, exercises with solutions, conclusions with their numbers."""

from __future__ import annotations

import json
import re
from copy import deepcopy
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest

from lib import paths
from lib.correspondences import of_recording
from lib.recordings import Recording
from lib.simulator.texture import fundus_texture
from lib.workbench import pages, report
from notebooks.figures import course
from tests.remembering import remembering_teacher

TAUGHT = ("00", "01", "02", "03", "04", "05", "06", "08")
WALK = [path for path in sorted(paths.NOTEBOOKS.glob("*.ipynb")) if path.stem[:2] in TAUGHT]
EXERCISED = sorted(paths.NOTEBOOKS.glob("*.ipynb"))
EQUATIONS = range(1, 8)  # of the paper
#: Worked out in cells too, though the paper gives them no number.
METHOD = {
    "depth-noise", "rolling-shutter", "half-pixel", "loss", "hourglass", "decoding", "elimination", "deepmatching",
    "epipolar", "triangulation", "spline", "drift",
}  # fmt: skip


def each(notebooks):
    return pytest.mark.parametrize("path", notebooks, ids=[path.stem for path in notebooks])


def tags(cell) -> set[str]:
    return set(cell.metadata.get("tags", []))


@cache
def cells(path: Path) -> list:
    return nbformat.read(path, as_version=4).cells


def worked_out(path: Path) -> list:
    return [cell for cell in cells(path) if any(t in METHOD or t.startswith("equation-") for t in tags(cell))]


def solutions(path: Path) -> list[str]:
    text = "\n".join(cell.source for cell in cells(path) if cell.cell_type == "markdown")
    return re.findall(r"<summary>Solution</summary>.*?```python\n(.*?)```.*?</details>", text, re.DOTALL)


def begun(path: Path, until: str | None = None) -> dict:
    """Names that a notebook's cells tagged "basis" make, up to the cell `until`; nobody else has them."""
    before = [cell.id for cell in cells(path)]
    before = before if until is None else before[: before.index(until)]
    basis = [cell for cell in cells(path) if tags(cell) & {"parameters", "basis"} and cell.id in before]
    return own(made(path, len(basis)))


@cache
def made(path: Path, count: int) -> dict:
    """Names that the first `count` of these cells make: each cell is executed once."""
    if count == 0:
        return {"__name__": "notebook"} | stand_ins(path.stem[:2])
    names = own(made(path, count - 1))
    cell = [cell for cell in cells(path) if tags(cell) & {"parameters", "basis"}][count - 1]
    source = "\n".join(line for line in cell.source.splitlines() if not line.startswith("%"))
    exec(compile(source, cell.id, "exec"), names)
    return names


def own(names: dict) -> dict:
    """A copy of everything but modules and what cannot be copied; the notebook's functions see the copies."""
    same: dict = {}  # what two names share they share in the copy
    found = {}
    for name, value in names.items():
        try:
            found[name] = value if isinstance(value, ModuleType) else deepcopy(value, same)
        except TypeError:  # a video, say
            found[name] = value
    for name, value in names.items():
        if isinstance(value, FunctionType) and value.__globals__ is names:
            found[name] = FunctionType(value.__code__, found, value.__name__, value.__defaults__, value.__closure__)
            found[name].__kwdefaults__ = value.__kwdefaults__
    return found


@pytest.fixture(scope="module", autouse=True)
def worked_out_once():
    """Solutions go on from what a notebook has worked out."""
    with remembering_teacher():
        yield


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    monkeypatch.setattr(report, "show", lambda page, *_: plt.close(page))
    monkeypatch.setattr(report, "record", lambda *_, **__: None)


def test_every_equation_and_every_step_has_its_cell():
    found = {tag for path in WALK for cell in worked_out(path) for tag in tags(cell)}
    assert {f"equation-{n}" for n in EQUATIONS} | METHOD <= found


def test_notebook_0_says_where_each_equation_is_worked_out():
    (path,) = (path for path in WALK if path.stem.startswith("00"))
    table = "\n".join(cell.source for cell in cells(path) if cell.id == "00-equations")
    for number in EQUATIONS:
        (place,) = {p.stem[:2] for p in WALK for cell in worked_out(p) if f"equation-{number}" in tags(cell)}
        assert re.search(rf"^\| \({number}\) .*\b{place}_", table, re.MULTILINE), number


@cache
def stand_ins(number: str) -> dict:
    """What a notebook has from the detector and from matching, made from the truth of the recording that ships."""
    source = Recording.open(paths.SHIPPED_RECORDING)
    truth, rng = source.truth, np.random.default_rng(0)
    if number == "03":
        return {"source": source, "rows": of_recording(source, truth.u_left, truth.u_right)}
    if number == "00":
        noisy = (u + rng.normal(0, 0.7, u.shape) for u in (truth.u_left, truth.u_right))
        return {"found": of_recording(source, *noisy)}
    if number != "04":
        return {}
    u = np.stack(np.meshgrid(np.linspace(300, 1600, 40), np.linspace(200, 900, 25)), axis=-1).reshape(-1, 2)
    x_mm = truth.surface(u) + rng.normal(0, 0.01, (len(u), 3))
    x_mm[rng.random(len(u)) < 0.1] += 0.5 * truth.rig.left.viewing_direction
    domain = (250.0, 150.0, 1650.0, 950.0)
    seen = {"u_tool": (truth.u_left[0], truth.u_right[0]), "u_points": u, "points": SimpleNamespace(x_mm=x_mm)}
    return {"rig": truth.rig, "domain": domain} | seen


WORKED = [(path, cell) for path in WALK for cell in worked_out(path)]


@pytest.mark.parametrize(("path", "cell"), WORKED, ids=[cell.id for _, cell in WORKED])
def test_a_cell_that_works_out_a_step_agrees_with_the_library(path, cell, monkeypatch):
    compared = []
    names = begun(path, until=cell.id)
    names["agree"] = lambda *a, **k: compared.append(course.agree(*a, **k))
    exec(compile(cell.source, cell.id, "exec"), names)
    assert compared
    code = [line for line in cell.source.splitlines() if line.strip() and not line.strip().startswith("#")]
    assert len(code) <= 28, "short enough to be changed"


@pytest.mark.parametrize(
    "path", [pytest.param(p, id=p.stem, marks=[pytest.mark.slow] * p.stem.startswith("07")) for p in EXERCISED]
)
def test_exercises_have_a_hint_and_a_solution_that_runs(path, monkeypatch):
    # An eye of half as many pixels a side is drawn in an eighth of the time, and a solution that does nothing is as far off.
    monkeypatch.setattr("lib.simulator.eye.fundus_texture", lambda seed, side, rim: fundus_texture(seed, side // 2, rim))
    text = next(cell.source for cell in cells(path) if cell.id.endswith("-exercises"))
    exercises = re.findall(r"^\*\*\d+\. ", text, re.MULTILINE)
    assert len(exercises) >= 3
    assert text.count("<summary>Hint</summary>") == text.count("<summary>Solution</summary>") == len(exercises)
    assert len(solutions(path)) == len(exercises)
    names = begun(path)
    for solution in solutions(path):
        assert "assert " in solution, "a solution states what it finds"
        exec(compile(solution, path.stem, "exec"), dict(names))


@each(WALK)
def test_bookkeeping_is_one_folded_cell_a_section(path):
    section = 0
    for cell in cells(path):
        if cell.cell_type == "markdown" and re.match(r"##? ", cell.source):
            section = 0
        if cell.cell_type == "code" and "report.record(" in cell.source:
            section += 1
            assert "record" in tags(cell) and cell.metadata.jupyter.source_hidden, cell.id
            assert section == 1, f"{cell.id}: the section has such a cell already"


@each(WALK)
def test_lines_are_short(path):
    for cell in cells(path):
        for line in cell.source.splitlines():
            assert len(line) <= 100 or line.startswith("|"), f"{cell.id}: {line}"


def claims(path: Path) -> dict[str, str]:
    (cell,) = (cell for cell in cells(path) if "claims" in tags(cell))
    names: dict = {}
    exec(compile(cell.source, cell.id, "exec"), {"learnt": names.update})
    return names


@each(WALK)
def test_conclusions_take_their_numbers_from_the_run(path):
    source = "\n".join(cell.source for cell in cells(path) if "record" in tags(cell))
    names = re.findall(r'f?"([a-z{][a-z0-9_.{}]*)"', source)
    stems = [re.sub(r"\{[^}]*\}", "(.*)", name.replace(".", r"\.")) for name in names]
    timed = [re.findall(r'report\.timed\(f?"([a-z0-9_]+)"', cell.source) for cell in cells(path)]
    stems += [f"seconds_{name}" for found in timed for name in found]
    for text, condition in claims(path).items():
        for name in course.metrics_named(text + condition):
            assert any(re.fullmatch(stem, name) for stem in stems), f"{name} is not recorded here"
        told = re.sub(r"\{[^{}]*\}|(Eq\. |Sec\. |notebooks? |PCK@|the paper's )\(?[\d.]+\)?|\d(?=D)|L1|[245]-?fold", "", text)
        assert not re.search(r"\d", told), f"a number that no metric states: {text}"


def test_conclusions_hold_in_the_newest_run():
    """Signs and sizes of the claims against metrics.json, where `lib run` was called before."""
    known: dict[str, dict] = {}
    for file in sorted(paths.RUNS.glob("*/metrics.json"), key=lambda file: file.stat().st_mtime):
        run = json.loads(file.read_text(encoding="utf-8"))
        own = run["parameters"].get("recording")
        known |= {m["name"]: m for m in run["metrics"] if not own}
    if not known:
        pytest.skip("no run yet: `python3 -m lib run`")
    values = {name: metric["value"] for name, metric in known.items()}
    for path in WALK:
        for text, condition in claims(path).items():
            names = course.metrics_named(text + condition)
            if set(names) <= set(values):
                lacking = [name for name in names if values[name] is None]
                assert not lacking, f"{path.stem}: the run has no value of {', '.join(lacking)}: {text}"
                assert course.holds(condition, values), f"{path.stem}: {course.filled(text, values)}"
                for name in course.metrics_named(condition):
                    if "seconds" in name or "_hz" in name:  # another machine, or a busy one, must not refute it
                        for other in (values[name] / 3, values[name] * 3):
                            assert course.holds(condition, values | {name: other}), f"{path.stem}: only here: {text}"
                if any(re.match(r"recorded\b|.*, recorded\b", known[name]["note"]) for name in course.metrics_named(text)):
                    assert "recorded" in text, f"{path.stem}: say that it is recorded: {text}"


def test_a_difference_is_refused_and_a_claim_that_fails_says_so(monkeypatch, capsys):
    with pytest.raises(AssertionError, match="differ by 1"):
        course.agree("x", [1.0, 2.0], [1.0, 3.0], within=1e-6)
    with pytest.raises(AssertionError):
        course.agree("x", [np.nan], [0.0], within=1.0)
    course.agree("x", 1.0, 4.5, within=6, unit="grey levels")
    assert capsys.readouterr().out == "x: this cell and lib differ by 3.5e+00 grey levels; up to 6 is accepted.\n"
    monkeypatch.setattr(report, "RECORDED", {"a_um": 3.0, "b_um": 1.0, "c_um": None})
    told = {"Wide: {a_um:.0f} um.": "{a_um} > 2", "Small: {b_um:.0f} um.": "{b_um} > 2", "{c_um}": "{c_um} > 0"}
    page = course.learnt(told).data
    assert page.splitlines()[0] == "- Wide: 3 um." and "**Not all of this holds in this run:** Small" in page
    assert "- One more conclusion is left out" in page
    assert "Without a value in this run: c_um." in page and "no truth" in course.learnt({"{d_um}": "{d_um} > 0"}).data
    assert "2 more conclusions are left out" in course.learnt(told | {"{d_um}": "{d_um} > 0"}).data


def test_folded_code_and_solutions_are_folded_in_the_page():
    html = pages.markdown_html("<details><summary>Solution</summary>\n\n```python\nx = 1\n```\n\n</details>")
    assert html.index("<details>") < html.index("<pre") < html.index("</details>")
