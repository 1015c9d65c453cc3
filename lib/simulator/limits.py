"""Checks of settings: each rule is one line that names the setting, the rule and the value that broke it."""

from collections.abc import Callable


def check(settings: object, names: str, holds: Callable[[object], bool], rule: str) -> None:
    """Raise ValueError for the first of the attributes `names` (separated by spaces) whose value breaks the rule.

    >>> from types import SimpleNamespace
    >>> check(SimpleNamespace(gloss=-1), "gloss", lambda value: value >= 0, "must not be negative")
    Traceback (most recent call last):
    ValueError: gloss: must not be negative, got -1.
    """
    for name in names.split():
        value = getattr(settings, name)
        if not holds(value):
            raise ValueError(f"{name}: {rule}, got {value}.")
