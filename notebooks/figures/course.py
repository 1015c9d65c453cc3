"""Tools of the course: compare a cell's result with the library's, read recorded tables, check conclusions on the run."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from IPython.display import Markdown
from numpy.typing import ArrayLike

from lib import paths
from lib.workbench import report, results

_NUMBER = re.compile(r"\{([a-z][a-z0-9_.]*?)(:[^{}]*)?\}")


def agree(what: str, here: ArrayLike, library: ArrayLike, *, within: float, unit: str = "") -> None:
    """Print the largest difference between a cell's own result and the library's; AssertionError if it exceeds `within`."""
    gap = float(np.max(np.abs(np.asarray(here, dtype=float) - np.asarray(library, dtype=float))))
    line = f"{what}: this cell and lib differ by {gap:.1e} {unit}".rstrip() + f"; up to {within:g} is accepted."
    assert gap <= within, line  # a NaN fails too
    print(line)


def is_paper(profile: str) -> bool:
    """True for the profile "paper", False for "quick"; a ValueError names any other."""
    if profile not in ("quick", "paper"):
        raise ValueError(f'profile = {profile!r}: give "quick" or "paper".')
    return profile == "paper"


def in_range(**given: tuple[float, float, float]) -> None:
    """Check parameters before anything is computed: name=(value, least, most).  Raises ValueError outside of [least, most].

    >>> in_range(share=(1.5, 0, 1))
    Traceback (most recent call last):
    ValueError: share = 1.5: give a value from 0 to 1.
    """
    for name, (value, least, most) in given.items():
        if not least <= value <= most:  # a NaN fails too
            raise ValueError(f"{name} = {value:g}: give a value from {least:g} to {most:g}.")


def metrics_named(text: str) -> list[str]:
    """The metrics that a conclusion or its condition names, ``{name}`` or ``{name:.1f}``.

    >>> metrics_named("{surface_rms_um:.1f} um, a {surface_rms_sphere_prior_um:.0f}th")
    ['surface_rms_um', 'surface_rms_sphere_prior_um']
    """
    return [name for name, _ in _NUMBER.findall(text)]


def filled(text: str, values: Mapping[str, float]) -> str:
    """The text with the metrics' values in place of their names.

    >>> filled("{surface_rms_um:.1f} um", {"surface_rms_um": 8.66})
    '8.7 um'
    """
    return _NUMBER.sub(lambda found: format(values[found[1]], (found[2] or ":.3g")[1:]), text)


def holds(condition: str, values: Mapping[str, float]) -> bool:
    """True if a condition on metrics holds.

    >>> holds("2 * {a_um} < {b_um}", {"a_um": 1.0, "b_um": 3.0})
    True
    """
    return bool(eval(_NUMBER.sub(lambda found: repr(float(values[found[1]])), condition), {"__builtins__": {"abs": abs}}))


def learnt(claims: Mapping[str, str]) -> Markdown:
    """Conclusions with this run's numbers, as a list.  One whose condition fails is marked.

    Args:
        claims: Text -> condition.  Both name metrics as ``{name}``, which `report.record` has recorded before.  If a metric
            was not measured (no truth, no real data), the conclusion is left out and counted.
    """
    known = {name: value for name, value in report.RECORDED.items() if value is not None}
    measured = {text: condition for text, condition in claims.items() if {*metrics_named(text + condition)} <= set(known)}
    lines = []
    for text, condition in measured.items():
        doubt = "" if holds(condition, known) else "**Not all of this holds in this run:** "
        lines.append(f"- {doubt}{filled(text, known)}")
    if missing := len(claims) - len(measured):
        more = " more" if measured else ""
        rest = f"One{more} conclusion is" if missing == 1 else f"{missing}{more} conclusions are"
        named = {name for text, condition in claims.items() for name in metrics_named(text + condition)}
        empty = [name for name in sorted(named) if report.RECORDED.get(name, 0.0) is None]
        why = "The recording may have no truth or no labels, or a real data set, Open3D or a recorded table may be missing."
        if empty:
            why = f"Without a value in this run: {', '.join(empty)}. What they measure did not happen, or there were no data."
        lines.append(f"- {rest} left out: this run could not measure all the numbers. {why}")
    return Markdown("\n".join(lines))


class _Absent:
    """Replaces a table that was never recorded: every access raises LookupError."""

    def __getattr__(self, name: str) -> object:
        raise LookupError("every row")


@contextmanager
def recorded_table(name: str, folder: Path = paths.RESULTS) -> Iterator[results.Table]:
    """Give a block of a notebook the recorded table `name`.  If the table lacks something, print a line and end the block.

    >>> with recorded_table("never_swept") as table:
    ...     print(table.columns["error_um"].mean())
    Left out: the recorded table never_swept lacks every row. `python3 -m lib sweep studies/never_swept --record` records it.
    """
    table = results.read(name, folder)
    try:
        yield _Absent() if table is None else table
    except LookupError as lacking:
        what = "a row" if isinstance(lacking, IndexError) else str(lacking)
        print(f"Left out: the recorded table {name} lacks {what}. `python3 -m lib sweep studies/{name} --record` records it.")
