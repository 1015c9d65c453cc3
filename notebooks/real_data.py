"""Where the real data sets lie that notebooks and tests use.  They do not ship: `data/README.md` says where to get each."""

import os
from pathlib import Path

from lib import paths

VARIABLE = "MICROSTEREO_DATA"


def folder(name: str) -> Path | None:
    """The folder of a data set, such as ``"fundus"``, in that which ``MICROSTEREO_DATA`` names; None where it is not."""
    root = os.environ.get(VARIABLE)
    found = paths.ROOT / root / name if root else None
    return found if found and found.is_dir() else None


def missing_line(name: str) -> str:
    """The one line that is told when a data set is not at hand."""
    return f"Skipped: the real data set '{name}' is not at hand; point {VARIABLE} at the folder that holds it."
