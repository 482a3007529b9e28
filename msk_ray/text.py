"""Makes text from files and users safe for display on a terminal.

A label or an error may contain anything. On a terminal, an escape sequence could clear the screen, rename the window or
overwrite earlier output, and text after a newline could look like a line of this program.
"""

import unicodedata
from collections.abc import Mapping
from typing import Any

_HIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Unicode categories of invisible characters: controls, format (direction of writing), surrogates, separators."""


def printable(text: str) -> str:
    r"""`text` on one line, with every control character escaped as in Python: `\n`, `\x1b`, `\u202e`."""
    if text.isprintable():
        return text
    return "".join(_visible(character) for character in text)


def printable_lines(text: str) -> str:
    """The same for text of several lines, keeping line breaks."""
    return "\n".join(printable(line) for line in text.split("\n"))


def describe(value: Any) -> str:
    """A value as tables show it: `1e-05`, `[0.33, 1]`, `start=8 end=32`."""
    if isinstance(value, bool) or value is None:
        return str(value).lower() if value is not None else "null"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, Mapping):
        return " ".join(f"{key}={describe(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return "[" + ", ".join(describe(item) for item in value) + "]"
    return str(value)


def _visible(character: str) -> str:
    if unicodedata.category(character) not in _HIDDEN:
        return character
    return character.encode("unicode_escape", "surrogatepass").decode()
