"""The annotator's page in a real Chromium: clicks, keys, and what happens when the page or the kernel goes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from lib import recordings
from lib.cameras import AffineCamera, StereoRig
from lib.correspondences import of_recording
from lib.recordings import Annotator, Recording, RecordingWriter
from tests.browser import Chromium, Kernel, wait

pytestmark = pytest.mark.slow
SCRIPT = Path(recordings.__file__).with_name("annotator.js")
SIZE, N = (960, 540), 3
RIG = StereoRig(AffineCamera([[60, 0, 0, 300], [0, 60, 0, 200]]), AffineCamera([[60, 0, 7, 330], [0, 60, 1, 210]]))
TOOL_MM = np.array([[0, 0, 0], [5, 1.5, 0.4], [5, -1.5, 0.2]], float)
#: Where the pictures show a spot: (left, right) of each landmark.
SPOTS = np.array([[[201.25, 150.5], [480.0, 270.75], [733.5, 401.0]], [[250.0, 140.25], [500.75, 300.0], [700.0, 420.5]]])
ROOT = "document.querySelector('.ms-annotator')"


def picture(side: int) -> np.ndarray:
    """Grey, with a white spot of 3 px radius on a black disc at each place, exact to a sixteenth of a pixel."""
    big, image = 16, np.full((SIZE[1], SIZE[0], 3), 110, np.uint8)
    for x, y in SPOTS[side]:
        x0, y0 = int(x) - 20, int(y) - 20
        patch = np.full((41 * big, 41 * big, 3), 110, np.uint8)
        centre = [round((v + 0.5) * big - 0.5) for v in (x - x0, y - y0)]
        cv2.circle(patch, centre, 12 * big, (0, 0, 0), -1)
        cv2.circle(patch, centre, 3 * big, (255, 255, 255), -1)
        image[y0 : y0 + 41, x0 : x0 + 41] = cv2.resize(patch, (41, 41), interpolation=cv2.INTER_AREA)
    return image


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page") / "mine"
    pair = [picture(side) for side in (0, 1)]
    with RecordingWriter(folder, name="mine", fps=25, image_size_px=SIZE, suffix=".png") as writer:
        for _ in range(N):
            writer.add(*pair)
        writer.kinematics(np.linspace(0, 0.2, 11), np.repeat(TOOL_MM[None], 11, axis=0))
    return folder


@pytest.fixture
def folder(template, tmp_path):
    return shutil.copytree(template, tmp_path / "mine")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    made = Chromium(tmp_path_factory.mktemp("profile"))
    yield made
    made.quit()


def opened(browser: Chromium, annotator: Annotator, **size: object) -> Kernel:
    kernel = Kernel(annotator, SCRIPT)
    browser.goto(kernel.address, **size)
    browser.until(f"{ROOT}?.dataset.frame !== undefined", "the page shows a frame")
    browser.settle()
    return kernel


def saved(browser: Chromium) -> None:
    browser.until(f"{ROOT}.querySelector('.state').textContent.startsWith('saved')", "the page says that it saved")


def labels(folder):
    return Recording.open(folder).annotations


def spots_on_screen(browser: Chromium, side: int) -> list[np.ndarray]:
    """Where a person sees the white spots of a view, in CSS pixels: from the screenshot alone."""
    box = json.loads(browser.value(
        f"(() => {{ const r = {ROOT}.querySelectorAll('.view')[{side}].getBoundingClientRect();"
        " return JSON.stringify([r.left, r.top, r.width, r.height]) })()"
    ))  # fmt: skip
    x0, y0, width, height = (round(v * browser.scale) for v in box)
    image = browser.picture()[y0 : y0 + height, x0 : x0 + width].astype(int)
    image[: round(34 * browser.scale), : round(80 * browser.scale)] = 110  # the view's name
    white = (image.min(axis=2) > 150).astype(np.uint8)
    dark = cv2.dilate((image.max(axis=2) < 60).astype(np.uint8), np.ones((3, 3)))
    count, _, stats, _ = cv2.connectedComponentsWithStats(white)
    found = []
    for k in range(1, count):
        x, y, w, h, _ = stats[k]
        ring = dark[max(y - 3, 0) : y + h + 3, max(x - 3, 0) : x + w + 3]
        inside = 0 < x and 0 < y and x + w < image.shape[1] and y + h < image.shape[0]
        if inside and 0.7 < w / h < 1.4 and ring.mean() > 0.4 and w >= 2:
            patch = image[y - 2 : y + h + 2, x - 2 : x + w + 2].mean(axis=2)
            total = np.mgrid[: patch.shape[0], : patch.shape[1]] * patch / patch.sum()
            middle = total.sum(axis=(1, 2))[::-1] + (x - 2, y - 2)
            found.append((middle + 0.5 + (x0, y0)) / browser.scale)
    return sorted(found, key=lambda at: at[0])


@pytest.mark.parametrize(("scale", "steps"), [(1.0, 0), (1.0, -700), (1.5, -350), (2.0, 0), (3.0, -900)])
def test_a_click_lands_within_half_a_pixel(browser, folder, scale, steps):
    """At several zooms (turns of the wheel) and device scale factors; the spot is found in the screenshot."""
    annotator = Annotator(Recording.open(folder))
    opened(browser, annotator, scale=scale, width=1203, height=640)
    browser.value(f"{ROOT}.focus()")
    browser.press("l")  # the loupe would show a second spot
    saved(browser)
    for side in (0, 1):
        target = 1 if side else 2
        at = spots_on_screen(browser, side)[target]
        browser.wheel(*at, steps)
        browser.settle()
        near = min(spots_on_screen(browser, side), key=lambda one: np.hypot(*(one - at)))
        browser.press(str(target + 1))
        browser.click(*near)
        saved(browser)
        found = getattr(labels(folder), f"u_{'right' if side else 'left'}")[0]
        where = found[np.isfinite(found).all(axis=1)][0]
        assert np.abs(where - SPOTS[side, target]).max() < 0.5


def test_clicks_follow_the_landmarks_order_and_a_drag_only_pans(browser, folder):
    opened(browser, Annotator(Recording.open(folder)))
    saved(browser)
    for side in (0, 1):
        for at in spots_on_screen(browser, side)[:3]:
            browser.click(*at)
            browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=5, y=5)
            saved(browser)
    found = labels(folder)
    assert np.abs(np.stack([found.u_left[0], found.u_right[0]]) - SPOTS).max() < 0.8
    before = (folder / "annotations.json").read_bytes()
    browser.drag((300, 200), (360, 260))
    browser.settle()
    assert (folder / "annotations.json").read_bytes() == before


def test_by_keyboard_alone(browser, folder):
    """Suggestions, hidden and absent marks, undo, the cursor, the next frame: no mouse."""
    recording = Recording.open(folder)
    left, right = RIG.project(TOOL_MM)
    detected = of_recording(recording, *(np.repeat(u[None] + 2.0, N, axis=0) for u in (left, right)))
    annotator = Annotator(recording, rig=RIG, detected=detected)
    opened(browser, annotator)
    browser.press("Tab")  # reaches the annotator as every control of a page
    assert browser.value(f"document.activeElement === {ROOT}")
    browser.press("a", "d", "h")
    browser.until(f"{ROOT}.dataset.view === 'right'", "the other view follows")
    browser.press("x", "a", "a")
    saved(browser)
    found = labels(folder)
    np.testing.assert_allclose(found.u_left[0], left + [[0], [2], [0]], atol=1e-3)
    assert found.visibility_left[0].tolist() == [2, 2, 1] and found.visibility_right[0].tolist() == [-1, 2, 2]
    assert annotator.complete[0]
    browser.press("u", "u")
    saved(browser)
    assert labels(folder).visibility_right[0].tolist() == [-1, 0, 0]
    browser.press("r")
    browser.press("v", "2")
    browser.press("ArrowRight", "ArrowDown", "ArrowDown")
    browser.press("Enter")
    saved(browser)
    zoom = browser.value(f"{ROOT}.querySelector('.view').clientWidth") / SIZE[0]
    np.testing.assert_allclose(labels(folder).u_left[0, 1], left[1] + 2 + np.array([1, 2]) / zoom, atol=1e-3)
    browser.press("A", shift=True)
    browser.press("n")
    browser.until(f"{ROOT}.dataset.frame === '2'", "the next frame, the farthest from the label")
    browser.press("Delete", "+", "-", "0", "t", "c", "b", "l", "s", "?")
    saved(browser)
    assert not browser.value(f"{ROOT}.querySelector('.help').hidden")


def test_closing_the_page_loses_nothing(browser, folder):
    annotator = Annotator(Recording.open(folder), rig=RIG)
    kernel = opened(browser, annotator)
    browser.value(f"{ROOT}.focus()")
    browser.press("a", "a")
    browser.close_tab()  # at once
    wait(lambda: (folder / "annotations.json").exists() and (labels(folder).visibility_left[0] == 2).sum() == 2, "written")
    browser.goto(kernel.address)
    browser.until(f"{ROOT}?.dataset.frame !== undefined", "the page shows a frame")
    assert browser.value(f"{ROOT}.dataset.landmark") == "tip_2", "the next open landmark"


def test_marks_that_a_dead_kernel_did_not_write_come_back_with_the_next_one(browser, folder):
    recording = Recording.open(folder)
    kernel = opened(browser, Annotator(recording, rig=RIG))
    browser.value(f"{ROOT}.focus()")
    browser.press("a")
    saved(browser)
    kernel.dead = True
    browser.press("a", "x")
    browser.until(f"{ROOT}.querySelector('.state').textContent.includes('2 marks are kept')", "the page says so in red")
    assert labels(folder).visibility_left[0].tolist() == [2, 0, 0]
    kernel.annotator, kernel.dead = Annotator(Recording.open(folder), rig=RIG), False  # a new kernel, the same recording
    browser.call("Page.reload")
    browser.until(f"{ROOT}?.dataset.frame !== undefined", "the page shows a frame")
    saved(browser)
    wait(lambda: labels(folder).visibility_left[0].tolist() == [2, 2, -1], "what was kept is written")
    assert browser.value("localStorage.length") == 0


def test_a_page_beside_loses_nothing_and_shows_what_is_new(browser, folder):
    """Two pages show one recording: what the other could not save yet stays, what it saved is seen."""
    opened(browser, Annotator(Recording.open(folder), rig=RIG))
    other, kept = f"microstereo.annotator:{folder.resolve()}|another", [[["left", 0, 1, 30.0, 40.0, 2]]]
    browser.value(f"localStorage.setItem({json.dumps(other)}, {json.dumps(json.dumps(kept))}); {ROOT}.focus()")
    browser.press("a")
    saved(browser)
    assert browser.value("Object.keys(localStorage)") == [other]
    Annotator(Recording.open(folder)).mark("left", 1, "base", (50.0, 60.0))
    browser.press(".")
    browser.until(f"{ROOT}.dataset.frame === '1'", "the next frame")
    assert browser.value(f"{ROOT}.dataset.landmark") == "tip_1", "the base has a mark"
    browser.call("Page.reload")
    wait(lambda: labels(folder).u_left[0, 1].tolist() == [30, 40], "the page takes over what the other left")
    browser.until("localStorage.length === 0", "it is in the file")


def test_no_key_reaches_the_notebook_around(browser, folder):
    """There m would turn the cell into text, and the page would be gone."""
    opened(browser, Annotator(Recording.open(folder)))
    browser.value(f"{ROOT}.focus()")
    browser.value("document.addEventListener('keydown', (event) => { window.heard = (window.heard ?? '') + event.key; })")
    browser.press(*"my47ijk M", "Tab")
    assert browser.value("window.heard") == "Tab"


def test_a_folder_that_cannot_be_written_is_told_in_red(browser, folder, monkeypatch):
    annotator = Annotator(Recording.open(folder), rig=RIG)
    opened(browser, annotator)
    monkeypatch.setattr("lib.recordings.annotator.mark_coco", lambda *_: (_ for _ in ()).throw(PermissionError("read-only")))
    browser.value(f"{ROOT}.focus()")
    browser.press("a")
    browser.until(f"{ROOT}.querySelector('.state.bad')?.textContent.includes('read-only')", "the reason is shown")
    browser.press(".")
    browser.until(f"{ROOT}.dataset.frame === '1'", "the next frame")
    assert "read-only" in browser.value(f"{ROOT}.querySelector('.state.bad').textContent"), "it stays until a mark is saved"
    assert not (folder / "annotations.json").exists()
