"""Every page of a run in a real Chromium: of a tiny run, and of the last complete run in `runs/` where there is one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from lib import paths
from lib.workbench.command import complete_runs, run
from lib.workbench.pages import is_recorded
from tests.browser import Chromium

pytestmark = pytest.mark.slow

CELLS = [
    "from lib.workbench import report\nimport matplotlib.pyplot as plt\nfrom ipywidgets import IntSlider, Dropdown\n"
    "from notebooks.figures.interactive import explore\nfrom notebooks.figures.style import table",
    'report.record("landmark_median_error_px", 0.5, "px", note="of 100 landmarks")\n'
    'report.record("landmark_shipped_whole_frames_median_px", 0.4, "px", note="recorded, 4 seeds")',
    "def lines():\n    fig, ax = plt.subplots(); ax.plot([1, 2]); return fig\n"
    'report.show(lines(), "landmark_lines", "A line.")',
    'fig, ax = plt.subplots(figsize=(12, 3)); ax.imshow([[1, 2]])\nreport.show(fig, "landmark_image", "An image.")\nlines();',
    "def look(power, colour):\n    'A power.'\n    fig, ax = plt.subplots(figsize=(11, 3))\n"
    "    ax.plot([x**power for x in range(9)], color=colour)\n    return fig\n\n\n"
    "explore(look, power=IntSlider(2, 0, 9), colour=Dropdown(options=['red', 'blue']))",
    "import plotly.graph_objects as go\nfrom notebooks.figures.interactive import show_scene\n"
    "mesh = go.Mesh3d(x=[0, 1, 0, 0], y=[0, 0, 1, 0], z=[0, 0, 0, 1], i=[0, 0, 0, 1], j=[1, 2, 1, 2], k=[2, 3, 3, 3],\n"
    "                 vertexcolor=['rgb(200,0,0)', 'rgb(0,99,0)', 'rgb(0,0,200)', 'rgb(0,0,0)'])\n"
    "view = go.Figure(mesh).add_scatter3d(x=[0, 1], y=[0, 1], z=[0, 1], mode='lines', line={'color': '#000', 'width': 5})\n"
    "eye, up = {'x': 1, 'y': 1, 'z': 1}, {'x': 0, 'y': 0, 'z': 1}\n"
    "show_scene(view.update_layout(scene_camera={'eye': eye, 'up': up}), 'A body.')",
    "import numpy as np\nfrom IPython.display import display\n"
    "from notebooks.figures.interactive import epipolar_pointer, swipe\n"
    "left = np.zeros((60, 100, 3), np.uint8)\nF = np.array([[0, 0, 0], [0, 0, 1], [0, -1, 0]])\n"
    "display(swipe(left, left + 200, 'A pair'))\nepipolar_pointer(left, left, F, (50, 30), 'A pixel and its line')",
    "table(['a long name of a column'] * 9, [['1'] * 9], 'A wide table.')",
    "print('x' * 300)  # " + "a long comment " * 9,
]

#: What is wrong with the page that is open, as a list of sentences.
AUDIT = r"""(() => {
  const wrong = [];
  const name = (e) => `<${e.tagName.toLowerCase()} class="${e.className}"> ${e.textContent.trim().slice(0, 40)}`;
  for (const e of document.querySelectorAll("img")) {
    if (!e.alt.trim()) wrong.push(`no alternative text: ${name(e)} ${e.src.slice(0, 60)}`);
    if (!e.hidden && e.complete && !e.naturalWidth) wrong.push(`broken picture: ${e.alt}`);
  }
  for (const e of document.querySelectorAll("*"))
    if (e.localName.includes(":")) wrong.push(`an element that no browser draws: ${name(e)}`);
  const ids = [...document.querySelectorAll("[id]")].map((e) => e.id);
  for (const e of document.querySelectorAll('a[href^="#"]'))
    if (!ids.includes(decodeURIComponent(e.hash.slice(1)))) wrong.push(`an anchor to nowhere: ${e.hash}`);
  const wide = document.scrollingElement.scrollWidth;
  if (wide > innerWidth) {
    wrong.push(`${wide} px wide in a window of ${innerWidth}`);
    const over = [...document.querySelectorAll("main *")].filter((e) => e.getBoundingClientRect().right > innerWidth + 1);
    over.slice(0, 3).forEach((e) => wrong.push(`sticks out: ${name(e)}`));
  }
  const numbers = (text) => (text.match(/[\d.]+/g) || []).map(Number);
  const luminance = (rgb) => {
    const [r, g, b] = rgb.map((c) => (c /= 255) <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = (e) => {
    for (; e; e = e.parentElement) {
      const c = numbers(getComputedStyle(e).backgroundColor);
      if (c.length === 3 || c[3] === 1) return c.slice(0, 3);
    }
    return [255, 255, 255];
  };
  const pale = new Set();
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const e = walk.currentNode.parentElement, style = getComputedStyle(e);
    if (!walk.currentNode.data.trim() || !e.getClientRects().length) continue;
    if (e.closest("svg, script, .anchor-link, .plotly-view")) continue;
    const [a, b] = [luminance(numbers(style.color).slice(0, 3)), luminance(ground(e))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05), large = parseFloat(style.fontSize) >= 24;
    if (ratio < (large ? 3 : 4.5)) pale.add(`contrast ${ratio.toFixed(1)}: ${name(e)}`);
  }
  return [...wrong, ...[...pale].slice(0, 8)];
})()"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Chromium]:
    one = Chromium(tmp_path_factory.mktemp("profile"))
    yield one
    one.quit()


def last_run() -> list[Path]:
    """The folder of the last complete run of this checkout; none where nothing was run."""
    return [folder for folder, content in complete_runs(paths.RUNS) if "previous" in content][-1:]


@pytest.fixture(scope="module", params=["tiny", *last_run()], ids=lambda folder: getattr(folder, "name", folder))
def folder(request, write_notebook, tmp_path_factory) -> Path:
    if request.param != "tiny":
        return request.param
    books = tmp_path_factory.mktemp("notebooks")
    write_notebook(books, "02_landmark_detection", *CELLS, title="One of everything")
    runs = tmp_path_factory.mktemp("runs")
    assert run(runs=runs, notebooks=books)["state"] == "complete"
    return next(runs.iterdir())


def pages(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.html"))


def open_page(browser: Chromium, page: Path, width: int, scheme: str = "light") -> None:
    browser.goto("about:blank", width=width, height=900)
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    browser.call("Page.navigate", url=page.as_uri())
    browser.until(f"document.readyState === 'complete' && location.href.startsWith('{page.as_uri()}')", page.name)
    browser.settle()


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (400, "light"), (400, "dark")])
def test_pages_can_be_read(browser, folder, width, scheme):
    wrong = {}
    for page in pages(folder):
        open_page(browser, page, width, scheme)
        browser.value("document.querySelectorAll('details').forEach((e) => e.open = true)")
        browser.settle()
        found = browser.value(AUDIT)
        found += [f"console: {event['args'][0].get('value')}" for event in browser.told("Runtime.consoleAPICalled")
                  if event["type"] == "error"]  # fmt: skip
        found += [f"error: {event['exceptionDetails']['text']}" for event in browser.told("Runtime.exceptionThrown")]
        found += [f"log: {e['entry']['text']}" for e in browser.told("Log.entryAdded") if e["entry"]["level"] == "error"]
        asked = [event["request"]["url"] for event in browser.told("Network.requestWillBeSent")]
        found += [f"request: {url[:80]}" for url in asked if not url.startswith(("file:", "data:", "blob:", "about:"))]
        if found:
            wrong[page.name] = found
    assert wrong == {}


def test_sliders_move_their_pictures(browser, folder):
    moved = 0
    for page in pages(folder):
        open_page(browser, page, 1400)
        for box in range(browser.value("document.querySelectorAll('.explore').length")):
            at = f"document.querySelectorAll('.explore')[{box}]"
            shown = f"[...{at}.querySelectorAll('img')].filter((e) => !e.hidden).map((e) => e.src)"
            for knob in range(browser.value(f"{at}.querySelectorAll('input').length")):
                slider = f"{at}.querySelectorAll('input')[{knob}]"
                before = browser.value(shown)
                browser.value(f"{slider}.value = {slider}.value === {slider}.max ? {slider}.min : {slider}.max;"
                              f"{slider}.dispatchEvent(new Event('input'))")  # fmt: skip
                after = browser.value(shown)
                assert len(before) == len(after) == 1 and before != after, (page.name, box, knob)
                moved += 1
    assert moved or folder.name != "tiny"


def test_a_pair_is_swiped_and_a_line_follows_the_pointer(browser, folder):
    moved = 0
    for page in pages(folder):
        open_page(browser, page, 1400)
        slide = "const i = at.querySelector('input'); i.value = 20; i.dispatchEvent(new Event('input'))"
        point = "const s = at.querySelector('svg'), b = s.getBoundingClientRect(); s.dispatchEvent("
        point += "new PointerEvent('pointermove', { clientX: b.x + 9, clientY: b.y + 9 }))"
        parts = {"swipe": "getAttribute('style')", "epipolar": "querySelector('line').outerHTML"}
        for (kind, part), change in zip(parts.items(), (slide, point), strict=True):
            at = f"const at = document.querySelector('.{kind}');"
            if browser.value(f"document.querySelector('.{kind}') !== null"):
                before = browser.value(f"(() => {{ {at} return at.{part}; }})()")
                assert browser.value(f"(() => {{ {at} {change}; return at.{part}; }})()") != before, (page.name, kind)
                moved += 1
    assert moved or folder.name != "tiny"


def test_views_in_three_dimensions_draw(browser, folder):
    for page in pages(folder):
        open_page(browser, page, 1400)
        if browser.value("document.querySelectorAll('.plotly-view').length"):
            browser.until("document.querySelector('.plotly-view canvas')?.width > 0", f"{page.name} draws")
            browser.value("document.querySelector('.plotly-view').scrollIntoView()")
            box = browser.value(
                "(({ x, y, width, height }) => [x, y, width, height])"
                "(document.querySelector('.plotly-view').getBoundingClientRect())"
            )
            x, y, width, height = map(round, box)
            seen = browser.picture()[max(y, 0) : y + height, x : x + width]
            assert seen.std() > 3, f"{page.name}: empty"


def test_a_view_has_a_still_where_no_script_runs(browser, folder):
    for page in pages(folder):
        views = page.read_text(encoding="utf-8").count('class="plotly-view"')
        browser.goto("about:blank")
        browser.call("Emulation.setScriptExecutionDisabled", value=True)
        browser.call("Page.navigate", url=page.as_uri())
        browser.until(f"document.readyState === 'complete' && location.href.startsWith('{page.as_uri()}')", page.name)
        shown = "[...document.querySelectorAll('noscript img')].filter((e) => e.getBoundingClientRect().width > 100).length"
        assert browser.value(shown) == views
        hidden = "[...document.querySelectorAll('.plotly-view')].every((e) => e.getBoundingClientRect().height === 0)"
        assert browser.value(hidden)


def test_numbers_are_found_by_their_words(browser, folder):
    """A run of a few notebooks may hold no recorded number; then none is shown."""
    open_page(browser, folder / "index.html", 1400)
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["metrics"]
    at, rows = "document.getElementById('find')", "[...document.querySelectorAll('#all tbody tr')]"
    assert browser.value(f"{rows}.length") == len(metrics)
    for words in ("RECORDED", metrics[-1]["name"], f"{metrics[0]['unit']} {metrics[0]['notebook'][:2]}", "no such word"):
        browser.value(f"{at}.value = '{words}'; {at}.dispatchEvent(new Event('input'))")
        expected = browser.value(f"{rows}.filter((r) => {words.lower().split()}.every((w) => "
                                 "r.textContent.toLowerCase().includes(w))).length")  # fmt: skip
        assert browser.value(f"{rows}.filter((r) => !r.hidden).length") == expected
        assert (expected == 0) == (words == "no such word" or (words == "RECORDED" and not any(map(is_recorded, metrics))))
