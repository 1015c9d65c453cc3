"""Which notebooks run, and with which values of their parameters; all of it is checked before anything runs."""

import argparse
import ast
import contextlib
import logging
import math
import re
from collections.abc import Sequence
from pathlib import Path

import nbformat

from lib import paths

#: How the comment of a study's parameter ends: ``; grid: 75, 300, 1500``.
_GRID = re.compile(r";\s*grid:(.*)$")
#: A comma outside brackets.
_COMMA = re.compile(r",(?![^\[({]*[\])}])")


def choose_notebooks(names: Sequence[str] = (), folder: Path = paths.NOTEBOOKS) -> list[Path]:
    """The notebooks named, in the order of the paper; all of them for no name.

    A name is a path, a file's name, its stem, or the leading number (``03``); studies are found by stem too.  A ValueError
    for a name that fits none lists what there is.
    """
    shipped = sorted(folder.glob("[0-9]*.ipynb"))
    if not names:
        if not shipped:
            raise ValueError(f"{folder} holds no notebooks.")
        return shipped
    studies = sorted(folder.glob("studies/*.ipynb"))
    chosen = []
    for name in names:
        path = Path(name)
        fits = [path.resolve()] if path.suffix == ".ipynb" and path.is_file() else []
        fits = fits or [book for book in shipped if name in (book.name, book.stem, book.stem.split("_")[0])]
        fits = fits or [book for book in studies if path.with_suffix("") in (Path(book.stem), Path("studies", book.stem))]
        if not fits:
            there = [book.stem for book in shipped] + [f"studies/{book.stem}" for book in studies]
            raise ValueError(f"unknown notebook: {name}. There are: {', '.join(there)}.")
        chosen += [book for book in fits if book not in chosen]
    return sorted(chosen, key=lambda book: book.name)


def declared_parameters(notebook: Path) -> dict[str, str]:
    """Names and declared types ("int", "str", ...; "" where none is) of the cell tagged ``parameters``."""
    return {name: (entry["inferred_type_name"] or "").replace("None", "") for name, entry in _inspect(notebook).items()}


def declared_grid(notebook: Path) -> dict[str, list[str]]:
    """The values that a sweep tries, as texts: those that comments of the parameters name after ``; grid:``."""
    found = {name: _GRID.search(entry["help"] or "") for name, entry in _inspect(notebook).items()}
    return {name: split_values(grid[1]) for name, grid in found.items() if grid}


def split_values(text: str) -> list[str]:
    """The values of ``75, 300`` or ``[1, 2], [3]``, as texts.

    >>> split_values("[1, 2], band")
    ['[1, 2]', 'band']
    """
    return [value.strip() for value in _COMMA.split(text) if value.strip()]


def parse_parameters(pairs: Sequence[tuple[str, str]], notebooks: Sequence[Path]) -> dict[Path, dict]:
    """What each notebook is given: the pairs that it declares, as values of the declared type.

    Raises:
        ValueError: If no chosen notebook declares a name, or a text does not fit the declared type.
    """
    declared = {notebook: declared_parameters(notebook) for notebook in notebooks}
    known = {name for names in declared.values() for name in names}
    for name, _ in pairs:
        if name not in known:
            raise ValueError(f"unknown parameter: {name}. Declared are: {', '.join(sorted(known)) or 'none'}.")
    return {
        notebook: {name: _value(name, text, names[name]) for name, text in pairs if name in names}
        for notebook, names in declared.items()
    }


def positive(text: str) -> float:
    """A number of seconds on a command line; an `argparse.ArgumentTypeError` for anything but a finite number above 0."""
    with contextlib.suppress(ValueError):
        if 0 < float(text) < math.inf:
            return float(text)
    raise argparse.ArgumentTypeError(f"{text} is not a number of seconds above 0.")


def title_of(notebook: Path) -> str:
    """The first heading of the notebook, or its stem."""
    for cell in nbformat.read(notebook, as_version=4).cells:
        for line in cell.source.splitlines() if cell.cell_type == "markdown" else ():
            if line.startswith("#"):
                return line.lstrip("# ").strip()
    return notebook.stem


def _value(name: str, text: str, kind: str) -> object:
    """`text` as the declared type; without one, as the Python literal it is, or else as text."""
    kind = kind.split("|")[0].strip().split("[")[0]
    words = {"true": True, "false": False, "1": True, "0": False}
    simple = {"str": str, "int": int, "float": float, "bool": lambda text: words[text.lower()]}
    try:
        value = simple.get(kind, ast.literal_eval)(text)
        if kind in ("list", "tuple", "dict", "set") and type(value).__name__ != kind:
            raise ValueError(f"a {type(value).__name__}")
        return value
    except (ValueError, KeyError, SyntaxError):
        if kind in (*simple, "list", "tuple", "dict", "set"):
            raise ValueError(f"parameter {name}: {text!r} is not of type {kind}.") from None
        return {"true": True, "false": False, "none": None}.get(text.lower(), text)


def _inspect(notebook: Path) -> dict[str, dict]:
    import papermill

    logging.getLogger("papermill").setLevel(logging.ERROR)  # no word about notebooks without a parameters cell
    try:
        return papermill.inspect_notebook(str(notebook))
    except (OSError, ValueError, nbformat.ValidationError) as error:  # also text that is not JSON
        raise ValueError(f"{notebook}: not a notebook ({error}).") from None
