"""What files and users write, made safe for a terminal."""

import pytest

from msk_ray.text import printable, printable_lines


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("actor_lr=0.002, 4→16, ω², 日本", "actor_lr=0.002, 4→16, ω², 日本"),
        ("a\x1b[2Jb\x1b]0;title\x07", r"a\x1b[2Jb\x1b]0;title\x07"),
        ("a\rb\nc\td\x7f\x9b1m", r"a\rb\nc\td\x7f\x9b1m"),
        ("a\u202eb\u2028c\u200d", r"a\u202eb\u2028c\u200d"),
        ("torn \udcff", r"torn \udcff"),
        ("no-break\u00a0space", "no-break\u00a0space"),
    ],
)
def test_one_line_for_a_terminal(text: str, shown: str) -> None:
    assert printable(text) == shown
    printable(text).encode()


def test_lines_stay_lines() -> None:
    assert printable_lines("Does it\n  \x1b[31mmatter?") == "Does it\n  \\x1b[31mmatter?"
