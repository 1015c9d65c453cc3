"""Which notebooks, and which values for their parameters: everything that is checked before anything runs."""

from __future__ import annotations

import ast
import contextlib
import logging
from collections.abc import Sequence
from pathlib import Path

import nbformat

from lib import paths

__all__ = ["UsageError", "choose_notebooks", "declared_parameters", "parse_parameters", "title_of"]


class UsageError(ValueError):
    """The command was misspelt: an unknown notebook or parameter, or a value of the wrong type."""


def choose_notebooks(names: Sequence[str] = (), folder: Path = paths.NOTEBOOKS) -> list[Path]:
    """The notebooks named, in the order of the paper; all of them for no name.

    A name is a path, a file's name, its stem, or the leading number (``03``).

    Raises
    ------
    UsageError
        If a name fits none; the text lists what there is.
    """
    shipped = sorted(folder.glob("[0-9]*.ipynb"))
    if not names:
        if not shipped:
            raise UsageError(f"{folder} holds no notebooks.")
        return shipped
    chosen = []
    for name in names:
        path = Path(name)
        fits = [path.resolve()] if path.suffix == ".ipynb" and path.is_file() else []
        fits = fits or [book for book in shipped if name in (book.name, book.stem, book.stem.split("_")[0])]
        if not fits:
            raise UsageError(f"unknown notebook: {name}. There are: {', '.join(book.stem for book in shipped)}.")
        chosen += [book for book in fits if book not in chosen]
    return sorted(chosen, key=lambda book: book.name)


def declared_parameters(notebook: Path) -> dict[str, str]:
    """Names and declared types ("int", "str", ...; "" where none is) of the cell tagged ``parameters``."""
    import papermill

    try:
        with _quiet_papermill():
            found = papermill.inspect_notebook(str(notebook))
    except (ValueError, nbformat.ValidationError) as error:  # also text that is no JSON
        raise UsageError(f"{notebook}: not a notebook ({error}).") from None
    return {name: (entry["inferred_type_name"] or "").replace("None", "") for name, entry in found.items()}


def parse_parameters(pairs: Sequence[tuple[str, str]], notebooks: Sequence[Path]) -> dict[Path, dict]:
    """What each notebook is given: the pairs that it declares, as values of the declared type.

    Raises
    ------
    UsageError
        If no chosen notebook declares a name, or a text does not fit the declared type.
    """
    declared = {notebook: declared_parameters(notebook) for notebook in notebooks}
    known = {name for names in declared.values() for name in names}
    for name, _ in pairs:
        if name not in known:
            raise UsageError(f"unknown parameter: {name}. Declared are: {', '.join(sorted(known)) or 'none'}.")
    return {
        notebook: {name: _value(name, text, names[name]) for name, text in pairs if name in names}
        for notebook, names in declared.items()
    }


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
    try:
        if kind == "str":
            return text
        if kind == "bool":
            return {"true": True, "false": False, "1": True, "0": False}[text.lower()]
        if kind in ("int", "float"):
            return {"int": int, "float": float}[kind](text)
        if kind in ("list", "tuple", "dict", "set"):
            value = ast.literal_eval(text)
            if type(value).__name__ != kind:
                raise ValueError(type(value).__name__)
            return value
    except (ValueError, KeyError, SyntaxError):
        raise UsageError(f"parameter {name}: {text!r} is not of type {kind}.") from None
    with contextlib.suppress(ValueError, SyntaxError):
        return ast.literal_eval(text)
    return {"true": True, "false": False, "none": None}.get(text.lower(), text)


@contextlib.contextmanager
def _quiet_papermill():
    """No word about notebooks without a parameters cell: `parse_parameters` has its own."""
    logger = logging.getLogger("papermill")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)
