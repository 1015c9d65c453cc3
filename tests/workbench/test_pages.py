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


def test_an_equation_in_a_heading_is_an_element_that_browsers_draw():
    html = markdown_html(r"## Why the $\ell_1$ norm")
    assert "<svg " in html and "xmlns" not in html and "ns0:" not in html


def test_text_in_an_equation_keeps_its_words_apart_at_the_end_of_a_line():
    assert equation_svg("\\text{one\ntwo}", display=False) == equation_svg(r"\text{one two}", display=False)
