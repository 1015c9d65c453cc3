"""Atomic writing of files, TOML output, and digests.  Uses only the standard library."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """Write a file completely or not at all: yields a partial path, and renames it to `path` when the block succeeds.

    The partial file keeps the suffix, since many writers choose the format by it.  On any error (a full disk, or nothing
    was written) it is removed, and an existing file at `path` stays.

    >>> import tempfile
    >>> target = Path(tempfile.mkdtemp()) / "points.csv"
    >>> with whole(target) as partial:
    ...     _ = partial.write_text("x_mm")
    >>> target.read_text()
    'x_mm'
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {path.parent}; make it, or name another.")
    partial = path.with_name(f"{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        with open(partial, "rb+") as file:  # errors of delayed writing would otherwise go unnoticed
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 with unchanged line ends, completely or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data` completely or not at all."""
    with whole(path) as partial:
        partial.write_bytes(data)


def write_json(path: str | Path, value: object) -> None:
    """Write `value` as readable JSON; a ValueError refuses NaN and infinity, which JSON cannot express."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def toml(value: object) -> str:
    """A value in TOML notation.

    >>> print(toml({"fps": 25.0, "names": ["base"], "end_s": float("inf")}))
    { fps = 25.0, names = ["base"], end_s = inf }
    """
    if isinstance(value, dict):
        return f"{{ {', '.join(toml_entries(value))} }}"
    text = json.dumps(value, ensure_ascii=False)
    return {"Infinity": "inf", "-Infinity": "-inf", "NaN": "nan"}.get(text, text)


def toml_entries(values: Mapping[str, object]) -> list[str]:
    """``key = value`` in TOML notation for each entry of a table."""
    keys = (key if re.fullmatch(r"[\w-]+", key, re.ASCII) else json.dumps(key) for key in values)
    return [f"{key} = {toml(value)}" for key, value in zip(keys, values.values(), strict=True)]


def digest(*parts: str | Path | bytes, length: int = 12) -> str:
    """The first `length` hexadecimal digits of the SHA-256 of the given bytes and contents of files, concatenated."""
    total = hashlib.sha256()
    for part in parts:
        with open(part, "rb") if isinstance(part, str | Path) else io.BytesIO(part) as file:
            hashlib.file_digest(file, lambda: total)  # without reading a whole video into memory
    return total.hexdigest()[:length]
