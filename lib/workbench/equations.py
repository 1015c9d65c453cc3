"""TeX to SVG, so that a page shows its equations with neither network, nor scripts, nor fonts."""

import functools
import html
import re

import ziamath
from ziamath.tex import tex2mml

__all__ = ["svg"]

#: What the converter does not know, in its own words.
_REWRITES = [
    (re.compile(r"\\operatorname\*\{([^{}]*)\}_\{([^{}]*)\}"), r"\\underset{\2}{\\mathrm{\1}}\\,"),
    (re.compile(r"\\operatorname\*\{([^{}]*)\}_(\w)"), r"\\underset{\2}{\\mathrm{\1}}\\,"),
    (re.compile(r"\\operatorname\*?\{([^{}]*)\}"), r"\\mathrm{\1}\\,"),
    (re.compile(r"\\(begin|end)\{(aligned|gathered|align|equation)\}"), r"\\\1{align*}"),
    (re.compile(r"\\math(bb|cal|bf|rm|sf)\s+(\w)"), r"\\math\1{\2}"),
    (re.compile(r"\\[bB]igg?l\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\left\\lVert "),
    (re.compile(r"\\[bB]igg?r\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\right\\rVert "),
    (re.compile(r"\\[bB]igg?\s*\\(?:[lr]?Vert(?![A-Za-z])|\|)"), r"\\Vert "),
    (re.compile(r"\\tag\{([^{}]*)\}"), r"\\qquad\\mathrm{(\1)}"),
]


@functools.lru_cache(maxsize=4096)
def svg(tex: str, *, display: bool, size_px: float = 17.0) -> str:
    """An equation as inline SVG in HTML, on the line of the text; its TeX is the alternative text.

    TeX that the converter cannot read is shown as it is.
    """
    text = tex.strip()
    for pattern, replacement in _REWRITES:
        text = pattern.sub(replacement, text)
    try:
        if re.search(r"\\|&#x0005C;", tex2mml(text)):
            raise ValueError("a command that the converter does not know")
        drawn = ziamath.Latex(text, size=size_px, inline=not display)
        picture = drawn.svg()
    except Exception:  # whatever the converter stumbles over: the reader still gets the TeX
        return f'<code class="tex">{html.escape(tex)}</code>'
    label = html.escape(" ".join(tex.split()), quote=True)
    style = "" if display else f' style="vertical-align:{drawn.getyofst():.2f}px"'
    picture = picture.replace("<svg ", f'<svg role="img" aria-label="{label}"{style} ', 1)
    return f'<div class="equation">{picture}</div>' if display else picture
