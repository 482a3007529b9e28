"""What files and users write, made safe for a terminal and for Markdown."""

import pytest

from msk_ray.text import markdown_cell, markdown_text, printable, printable_lines


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


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("[0.33, 1]", "[0.33, 1]"),
        ("a|b", r"a\|b"),
        ("a\nb", r"a\\nb"),
        ("<img src=x onerror=alert(1)> & co", "&lt;img src=x onerror=alert(1)&gt; &amp; co"),
        ("![x](http://example.org/x.png)", r"![x]\(http://example.org/x.png)"),
        ("`code` \\", "\\`code\\` \\\\"),
    ],
)
def test_a_cell_of_a_table(text: str, cell: str) -> None:
    assert markdown_cell(text) == cell


def test_a_paragraph_keeps_its_lines_and_pipes() -> None:
    assert markdown_text("a|b\n<b>c</b>") == "a|b\n&lt;b&gt;c&lt;/b&gt;"
