"""Folders of the real data sets that notebooks and tests use.  They do not ship; `data/README.md` says where to get them."""

import os
from pathlib import Path

from lib import paths

VARIABLE = "MICROSTEREO_DATA"


def folder(name: str) -> Path | None:
    """The folder of a data set, such as ``"fundus"``, inside the folder ``MICROSTEREO_DATA``; None if there is none."""
    root = os.environ.get(VARIABLE)
    found = paths.ROOT / root / name if root else None
    return found if found and found.is_dir() else None


def missing_line(name: str) -> str:
    """The line to print if a data set is missing."""
    return f"Skipped: the real data set '{name}' is missing. Set {VARIABLE} to the folder that contains it."
