"""Prose and equations of the pages."""

from __future__ import annotations

import pytest

from lib.workbench.pages import equation_svg, markdown_html

TEX = [
    r"\begin{aligned} a &= b \\ c &= d \end{aligned}",
    r"\operatorname{diag}(x)",
    r"\bigl\lVert x \bigr\rVert_1",
    r"\mathbb R^3",
]


@pytest.mark.parametrize("tex", TEX)
def test_equations_are_drawn(tex):
    drawn = equation_svg(tex, display=True)
    assert drawn.startswith('<div class="equation"><svg ') and 'role="img"' in drawn


def test_tex_that_cannot_be_drawn_is_shown():
    assert equation_svg(r"\unheard{x} < 1", display=False) == r'<code class="tex">\unheard{x} &lt; 1</code>'


def test_markdown_keeps_code_and_dollars_apart():
    html = markdown_html("Cost `$a$` and $x < y$.")
    assert "<code>$a$</code>" in html and html.count("<svg ") == 1 and "x &lt; y" in html
