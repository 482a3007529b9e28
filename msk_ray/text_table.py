"""Tables for a terminal."""

from collections.abc import Sequence

from msk_ray.text import printable


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> str:
    """A table for a terminal of `width` columns; only the last column is cut. Control characters in cells are
    escaped."""
    body = [[printable(cell) for cell in row] for row in (header, *rows)]
    widths = [max(len(line[column]) for line in body) for column in range(len(header))]
    lines = []
    for number, line in enumerate(body):
        cells = [cell.ljust(size) for cell, size in zip(line, widths, strict=True)]
        text = "  ".join(cells).rstrip()
        lines.append(text if len(text) <= width else text[: max(1, width - 1)] + "…")
        if number == 0:
            lines.append("─" * min(width, sum(widths) + 2 * (len(widths) - 1)))
    return "\n".join(lines)
