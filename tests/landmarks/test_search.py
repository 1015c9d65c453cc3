"""The search for the tool where its window does not show it well."""

import numpy as np
import torch

from lib.landmarks import Detector
from lib.landmarks.detector import Landmarks
from lib.landmarks.heatmaps import decode, render
from lib.landmarks.network import HourglassConfig, StackedHourglass
from lib.landmarks.search import best_tools, likelihood, near_only, several_peaks
from lib.landmarks.windows import map_points

TOOL = np.array([[40.0, 50.0], [80.0, 40.0], [80.0, 60.0]])


def test_the_second_peak_is_found_once_the_first_is_taken_out():
    heatmaps = render(torch.tensor([[[20.0, 30.0]]]), (64, 96), 4) + 0.6 * render(torch.tensor([[[70.0, 33.0]]]), (64, 96), 4)
    u, height = several_peaks(heatmaps, 2, 4)
    assert np.allclose(u[:, 0], [[20, 30], [70, 33]], atol=0.5) and np.allclose(height[:, 0], [1.0, 0.6], atol=0.1)


def test_near_a_known_place_the_lower_peak_counts():
    elbow = torch.tensor(TOOL + [[0.0, 0.0], [-16.0, 4.0], [-16.0, -4.0]])[None]
    heatmaps = 0.4 * render(torch.tensor(TOOL)[None], (96, 128), 4) + render(elbow, (96, 128), 4)
    expected = TOOL[None] + 2.0
    expected[0, 2] = np.nan  # nothing is known of tip_2, so its highest peak counts
    # The border of what counts cuts off a part of the peak, so a closeup has to measure again.
    found = decode(near_only(heatmaps, expected, 0.2, 4), 4).u[0].numpy()
    assert np.allclose(found[:2], TOOL[:2], atol=2.0) and np.allclose(found[2], elbow[0, 2], atol=0.5)


def test_a_tool_needs_equal_jaws_and_the_tips_on_their_sides():
    wrong = np.array([[300.0, 200.0], [85.0, 61.0], [400.0, 60.0]])  # each a little higher than the true peak
    u, height = np.stack([wrong, TOOL]), np.stack([np.full(3, 0.6), np.full(3, 0.5)])
    assert best_tools(u, height, 1).tolist() == [[1, 1, 1]]
    mirrored = np.stack([TOOL[[0, 2, 1]], TOOL])
    ((_, one, two),) = mirrored[best_tools(mirrored, np.full((2, 3), 0.5), 1), np.arange(3)]
    assert one[1] <= two[1]
    assert len(best_tools(np.stack([TOOL, TOOL + 0.5]), np.full((2, 3), 0.5), 5)) <= 2  # tools that look alike count once


def test_of_two_tools_the_higher_one_is_likelier_and_of_equal_ones_the_open_one():
    shut = TOOL.copy()
    shut[1:] = [[80.0, 49.5], [80.0, 50.5]]
    pair = np.stack([shut, TOOL])
    assert likelihood(pair, np.array([0.5, 0.5])).argmax() == 1 and likelihood(pair, np.array([0.9, 0.5])).argmax() == 0
    assert np.array_equal(likelihood(np.full((1, 3, 2), np.nan), np.zeros(1)), [0.0])  # a tool without a window


def test_an_image_starts_from_the_tool_that_its_window_shows_best(monkeypatch):
    network = StackedHourglass(HourglassConfig(features=8, stacks=1))
    detector = Detector(network, tool_network=network)

    def landmarks(u: np.ndarray, confidence: float) -> Landmarks:
        return Landmarks(u, np.tile(np.eye(2), (*u.shape[:2], 1, 1)), np.full(u.shape[:2], confidence))

    sure_and_unsure = [landmarks(u[None], confidence) for u in (TOOL, TOOL + 200) for confidence in (0.9, 0.3)]
    rough = Landmarks.join(sure_and_unsure)  # whether the first stage is sure of a wrong one does not matter

    def proposed(self, image, *others):
        tools = np.concatenate([*others, np.stack([TOOL + 90, TOOL])])
        return tools, *shown(tools, len(tools))

    def shown(seen, n):
        return seen, np.where(np.linalg.norm(seen - TOOL, axis=2).max(1) < 20, 0.8, 0.2)

    monkeypatch.setattr(Detector, "proposed", proposed)
    monkeypatch.setattr(Detector, "stage_peaks", lambda self, images, u, stage: u)
    monkeypatch.setattr(Detector, "_shown", staticmethod(shown))
    found = detector.searched(np.zeros((4, 64, 96, 3), np.uint8), rough)
    assert np.array_equal(found.u, np.stack([TOOL] * 4)) and found.confidence[:, 0].tolist() == [0.9, 0.4, 0.4, 0.4]


def test_the_second_stage_sweeps_the_whole_image_and_gives_places_in_its_pixels(monkeypatch):
    network = StackedHourglass(HourglassConfig(features=8, stacks=1))
    detector, cuts = Detector(network, tool_network=network), []
    tool = np.array([[130.0, 260.0], [240.0, 220.0], [250.0, 262.0]])

    def cut(image, matrix, size):
        cuts.append((matrix, size))
        return np.zeros((*size[::-1], 3), np.uint8)

    def outputs(self, images, stage):
        return render(torch.from_numpy(map_points(cuts[-1][0], tool))[None].float(), images.shape[1:3], 4)

    monkeypatch.setattr("lib.landmarks.windows.cut", cut)
    monkeypatch.setattr(Detector, "outputs", outputs)
    tools, u, height = detector.swept(np.zeros((360, 640, 3), np.uint8))
    sharp = height > 0.9
    assert len(tools) == len(u) == len(height) and sharp.sum() >= 6
    assert np.abs(u[sharp] - tool).max() < 1.0
    corners = np.array([[0, 0], [639, 0], [0, 359], [639, 359]])
    for matrix, size in cuts:  # nothing of the image is left out
        at = map_points(matrix, corners)
        assert (at > -1.5).all() and (at < size + 0.5).all()
