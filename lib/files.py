"""Files written whole or not at all, text as TOML writes it, and digests.  Standard library only."""

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
    """Yield a partial path beside `path`; when the block ends well, what was written there takes the place of `path`.

    The partial file keeps the suffix, since many writers choose the format by it.  On any error (a full disk, or nothing
    was written) it is removed and the file that was there stays.

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
        with open(partial, "rb+") as file:  # an error of writing back would else go unnoticed
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 with the line ends that it has."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data`."""
    with whole(path) as partial:
        partial.write_bytes(data)


def write_json(path: str | Path, value: object) -> None:
    """Write `value` as readable JSON; NaN and infinity, for which it has no word, are a ValueError."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def toml(value: object) -> str:
    """A value as TOML writes it.

    >>> print(toml({"fps": 25.0, "names": ["base"], "end_s": float("inf")}))
    { fps = 25.0, names = ["base"], end_s = inf }
    """
    if isinstance(value, dict):
        return f"{{ {', '.join(toml_entries(value))} }}"
    text = json.dumps(value, ensure_ascii=False)
    return {"Infinity": "inf", "-Infinity": "-inf", "NaN": "nan"}.get(text, text)


def toml_entries(values: Mapping[str, object]) -> list[str]:
    """``key = value`` for each entry of a table, as TOML writes it."""
    keys = (key if re.fullmatch(r"[\w-]+", key, re.ASCII) else json.dumps(key) for key in values)
    return [f"{key} = {toml(value)}" for key, value in zip(keys, values.values(), strict=True)]


def digest(*parts: str | Path | bytes, length: int = 12) -> str:
    """The first `length` hexadecimal digits of the SHA-256 of bytes, and of what is in files, one after the other."""
    total = hashlib.sha256()
    for part in parts:
        with open(part, "rb") if isinstance(part, str | Path) else io.BytesIO(part) as file:
            hashlib.file_digest(file, lambda: total)  # a video need not fit into memory
    return total.hexdigest()[:length]
