"""Scores of a detector on labelled images; the detector is a stand-in with known errors."""

from dataclasses import replace

import numpy as np
import pytest

from lib import paths
from lib.landmarks import Landmarks, metrics
from lib.recordings import Recording
from lib.training.evaluation import Evaluation, evaluate
from lib.training.samples import LabelledImage, labelled_images
from notebooks.figures.landmarks import worst
from tests.toys import toy_images

IMAGES = toy_images(6)


def off_by(dx: float, confidence: float = 0.9):
    """A detector that is `dx` px off to the right in every image, in their order."""
    labels = iter(IMAGES)

    def detect(images: np.ndarray) -> Landmarks:
        u = next(labels).u[None] + [dx, 0.0]
        return Landmarks(u, np.broadcast_to(np.eye(2), (1, 3, 2, 2)).copy(), np.full((1, 3), confidence))

    return detect


def test_scores_are_those_of_known_errors():
    result = evaluate(off_by(2.0), IMAGES)
    assert result.scores.median_px == pytest.approx(2.0)
    assert result.scores.nees == pytest.approx(4.0)
    assert result.scores.labels == 18
    assert result.curve(np.array([0.01, 0.5])).tolist() == [0.0, 100.0]
    twice = Evaluation.joined([result, evaluate(off_by(4.0), IMAGES)])
    assert twice.scores.labels == 36
    assert twice.scores.median_px == pytest.approx(3.0)
    assert worst(twice, 1)[0] >= 6


def test_what_labels_err_is_not_held_against_the_covariances():
    result = evaluate(off_by(2.0), [image._replace(sd_px=np.array([0.0, 1.0, 1.0])) for image in IMAGES])
    nees = {name: scores.nees for name, scores in result.by_landmark().items()}
    assert nees == pytest.approx({"base": 4.0, "tip_1": 2.0, "tip_2": 2.0})


def test_only_labels_in_view_count():
    image = IMAGES[0]
    result = evaluate(off_by(1.0), [image._replace(visibility=np.array([2, 2, 0]))])
    assert result.scores.labels == 2
    assert result.length_px[0] == pytest.approx(metrics.tool_length_px(image.u[None])[0])
    assert list(result.by_landmark()) == ["base", "tip_1"]


def test_tips_without_a_base_say_nothing_of_the_confidence():
    """Without the tool's length nobody knows whether they are near enough."""
    tips = [image._replace(u=np.where(np.arange(3)[:, None] > 0, image.u, np.nan)) for image in IMAGES[:3]]
    labels = iter([*IMAGES[:3], *IMAGES[3:]])

    def detect(images: np.ndarray) -> Landmarks:
        u = next(labels).u[None]
        return Landmarks(u, np.broadcast_to(np.eye(2), (1, 3, 2, 2)).copy(), np.ones((1, 3)))

    assert evaluate(detect, [*tips, *IMAGES[3:]]).confidence_error == pytest.approx(0.0)


def test_precision_and_recall_of_detections():
    images = [image._replace(visibility=np.array([2, 1, 0])) for image in IMAGES]
    said = evaluate(off_by(1.0), images).detection()
    assert said["in_view_recall"] == said["visible_recall"] == 100
    assert said["in_view_precision"] == pytest.approx(100 * 2 / 3)
    assert said["visible_precision"] == pytest.approx(100 / 3)
    assert evaluate(off_by(1.0, 0.4), images).detection()["in_view_recall"] == 0


def test_an_unlabelled_landmark_is_neither_there_nor_absent():
    u = IMAGES[0].u.copy()
    u[2] = np.nan
    result = evaluate(off_by(1.0), [IMAGES[0]._replace(u=u)])
    assert result.visibility.tolist() == [[2, 2, -1]]
    assert result.detection()["in_view_precision"] == 100
    assert result.confidence_error == pytest.approx(0.1)


def test_groups_have_their_own_scores():
    result = evaluate(off_by(1.0), IMAGES)
    depth = np.tile([-0.2, 0.7, 3.0], (6, 1))
    groups = result.by({"near": np.abs(depth) < 0.5, "none": np.abs(depth) > 9})
    assert list(groups) == ["near"]
    assert groups["near"].labels == 6
    assert groups["near"].median_px == result.by_landmark()["base"].median_px
    assert list(result.by_visibility()) == ["visible"]


def test_nothing_to_evaluate_is_named():
    with pytest.raises(ValueError, match="images: no labelled image"):
        evaluate(off_by(0.0), [])
    absent = evaluate(off_by(0.0), [one._replace(visibility=np.zeros(3)) for one in IMAGES])
    assert absent.detection()["in_view_precision"] == 0
    with pytest.raises(ValueError, match="images: no label is in view"):
        absent.scores  # noqa: B018


def test_labels_are_the_truth_or_else_the_annotations():
    recording = Recording.open(paths.SHIPPED_RECORDING)
    true = next(iter(labelled_images(recording)))
    np.testing.assert_array_equal(true.u, recording.truth.u_left[0])
    annotations = recording.annotations
    annotations.visibility_left[0, 1] = 0  # COCO's "not labelled"
    clicked = next(iter(labelled_images(replace(recording, truth=None, annotations=annotations))))
    assert isinstance(clicked, LabelledImage)
    assert np.isnan(clicked.in_view[1]).all() and clicked.visibility[1] == 1
    np.testing.assert_array_equal(clicked.u[0], annotations.u_left[0, 0])
    annotations.visibility_left[:] = annotations.visibility_right[1:] = 0
    marked = labelled_images(replace(recording, truth=None, annotations=annotations))
    assert [one.name for one in marked] == ["right 0"]  # what nobody marked is not read
    with pytest.raises(ValueError, match=r"neither truth/ nor annotations\.json"):
        next(iter(labelled_images(replace(recording, truth=None, annotations=None))))
    annotations.visibility_left[[3, 9, 20, 33]] = 2
    sparse = labelled_images(replace(recording, truth=None, annotations=annotations), every=2)
    assert [one.name for one in sparse] == ["right 0", "left 9", "left 33"]  # every second of those that are labelled
    with pytest.raises(ValueError, match=r"landmarks are \['shaft', 'elbow', 'hook'\]; give one with \['base'"):
        next(iter(labelled_images(replace(recording, skeleton=("shaft", "elbow", "hook")))))
