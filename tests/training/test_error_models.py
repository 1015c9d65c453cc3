"""Fitted covariances and confidences are true on images that were not fitted on."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lib.landmarks import Detector, metrics
from lib.landmarks import detector as detectors
from lib.landmarks.error_model import FEATURES, ErrorModel
from lib.landmarks.network import OffsetConfig, OffsetNetwork
from lib.training import error_models
from lib.training.error_models import Seen, fit_error_models
from lib.training.evaluation import evaluate
from tests.remembering import remembering_detectors
from tests.toys import toy_images


@pytest.fixture(scope="module", autouse=True)
def said_once():
    """The same images are fitted on and evaluated again and again, and the networks stay the same."""
    with remembering_detectors():
        yield


@pytest.fixture(scope="module")
def small(trained):
    """A whole-frame detector, and toys that it has not seen."""
    return Detector(trained.network, error_models={"frame": ErrorModel(logit=(5.0, 0.0, 0.0, 0.0))}), toy_images(120, seed=5)


def test_calibration_makes_covariances_and_confidence_true(small):
    detector, frames = small
    result = evaluate(fit_error_models(detector, frames[:60]), frames[60:])
    assert 0.5 < result.scores.nees < 6
    assert 75 < result.scores.coverage_95 <= 100
    before = evaluate(detector, frames[60:])
    labelled = ~np.isnan(result.error_px)
    error = [metrics.calibration_error(r.landmarks.confidence[labelled], r.correct[labelled]) for r in (before, result)]
    assert error[1] <= max(error[0], 0.25)


def test_fitted_variance_of_known_errors():
    """Errors drawn with a variance that depends on feature, base or tip, and axis: the fit finds all three, and NEES is 2."""
    rng = np.random.default_rng(0)
    features = np.stack(
        [np.ones((6000, 3)), rng.normal(0, 1, (6000, 3)), rng.uniform(0.2, 1, (6000, 3))]
        + [np.zeros((6000, 3))] * (FEATURES - 3),
        2,
    )
    landmark = rng.integers(3, size=6000)
    along = 0.3 + 0.8 * features[:, 0, 1] + np.array([-0.6, 0.3, 0.3])[landmark]
    across = -1.2 + 0.2 * features[:, 1, 1]
    sigma = np.exp(np.column_stack([along, across]) / 2)
    errors = rng.normal(0, 1, (6000, 2)) * sigma
    correct = np.linalg.norm(errors, axis=1) < 2
    moved, known, exact = np.zeros((6000, 2)), np.ones(6000, bool), np.zeros(6000)
    fit = Seen(features, errors, np.full(6000, 2.0), landmark, moved, known, exact).fit(1e9)
    coefficients, of_logit = fit.coefficients[:, :2], fit.coefficients[:, 2]
    assert coefficients[:, :, 1] == pytest.approx(np.tile([0.8, 0.2], (3, 1)), abs=0.05)
    assert coefficients[1:, :, 0] - coefficients[0, :, 0] == pytest.approx(np.array([[0.9, 0], [0.9, 0]]), abs=0.1)
    log_variance = (coefficients[landmark] * features[:, :2]).sum(-1)
    squared = errors**2 / np.exp(log_variance)
    for own in (landmark == 0, landmark > 0):
        assert squared[own].mean(0) == pytest.approx([1, 1], abs=0.05)
    confidence = 1 / (1 + np.exp(-(of_logit[landmark] * features[:, 2]).sum(1)))
    for own in (landmark == 0, landmark > 0):
        assert metrics.calibration_error(confidence[own], correct[own]) < 0.05


def test_what_labels_err_themselves_is_not_the_detectors():
    """Clicks with three times the detector's error, or as large: its own variance and confidence are found."""
    rng = np.random.default_rng(1)
    features = np.concatenate([np.ones((8000, 3, 1)), np.zeros((8000, 3, FEATURES - 1))], axis=2)
    landmark, moved, known = rng.integers(3, size=8000), np.zeros((8000, 2)), np.ones(8000, bool)
    for own_sd, click_sd, exact in ((0.5, 1.5, 4000), (1.5, 1.5, 0)):  # and how many labels are exact
        label_sd = np.where(np.arange(8000) < exact, 0.0, click_sd)
        own = rng.normal(0, own_sd, (8000, 2))
        errors = own + rng.normal(0, 1, (8000, 2)) * label_sd[:, None]
        fit = Seen(features, errors, np.ones(8000), landmark, moved, known, label_sd).fit(1e9)
        assert np.exp(fit.coefficients[:, :2, 0]) == pytest.approx(np.full((3, 2), own_sd**2), rel=0.15)
        correct = (np.linalg.norm(own, axis=1) < 1).mean()
        assert 1 / (1 + np.exp(-fit.logit[0])) == pytest.approx(correct, abs=0.02)
    better = Seen(features, own / 5, np.ones(8000), landmark, moved, known, np.full(8000, 1.5)).fit(1e9)
    assert (np.exp(better.coefficients[:, :2, 0]) > 0.05 * 0.3**2).all()  # labels five times better than was said


def test_confidence_of_tips_has_a_constant_of_its_own():
    """Bases that are mostly wrong beside tips that are mostly right, with equal features."""
    rng = np.random.default_rng(3)
    features = np.concatenate([np.ones((6000, 3, 1)), np.zeros((6000, 3, FEATURES - 1))], axis=2)
    landmark = rng.integers(3, size=6000)
    errors = rng.normal(0, np.where(landmark == 0, 2.0, 0.5)[:, None], (6000, 2))
    exact = np.zeros((6000, 2)), np.ones(6000, bool), np.zeros(6000)
    fit = Seen(features, errors, np.ones(6000), landmark, *exact).fit(1e9)
    right = [(np.linalg.norm(errors[own], axis=1) <= 1).mean() for own in (landmark == 0, landmark > 0)]
    assert 1 / (1 + np.exp(-fit.coefficients[:, 2, 0])) == pytest.approx([right[0], right[1], right[1]], abs=0.01)
    assert ErrorModel(logit=(1.0, 2.0)).coefficients[:, 2, :2].tolist() == [[1.0, 2.0]] * 3  # one constant for all


def test_few_landmarks_change_a_prior_little():
    """Of errors twice as large as the prior says, thirty tell less than three thousand."""
    prior, rng = ErrorModel(((0.0,) * (FEATURES + 2),) * 2, (1.0,) + (0.0,) * (FEATURES - 1)), np.random.default_rng(2)
    features = np.concatenate([np.ones((3000, 3, 1)), np.zeros((3000, 3, FEATURES - 1))], axis=2)
    errors, landmark, moved = 2 * rng.normal(size=(3000, 2)), rng.integers(3, size=3000), np.zeros((3000, 2))
    seen = Seen(features, errors, np.full(3000, 2.0), landmark, moved, np.ones(3000, bool), np.zeros(3000))
    few = Seen(*(part[:30] for part in seen))
    little, much = (np.exp(part.fit(1e9, prior).coefficients[:, :2, 0]) for part in (few, seen))
    assert (1 < little).all() and (little < 0.7 * much).all() and much == pytest.approx(np.full((3, 2), 4), rel=0.1)


def test_closeups_that_know_nothing_do_no_harm(small, monkeypatch):
    """The corrections of an untrained offset network are a constant, which is bias, or noise, which is not believed."""
    for module in (error_models, detectors):
        monkeypatch.setattr(module, "TRACKED_FROM", 0.0)  # toys are too small to be sure of
    monkeypatch.setattr(detectors, "MISSING_BELOW", 0.0)  # nor does a window, in which they are larger, show what was learnt
    detector, frames = small
    torch.manual_seed(0)
    closeup = OffsetNetwork(OffsetConfig(4, 32)).eval()
    torch.nn.init.normal_(closeup.head[-1].weight, std=0.5)
    full = replace(detector, tool_network=detector.frame_network, closeup_network=closeup)
    frames = frames[:20]
    once = fit_error_models(full, frames)
    assert set(once.error_models) == {"frame", "tool", "again", "closeup", "closer", "tracking"}
    gain = np.array(once.error_models["closeup"].gain)
    assert ((gain >= 0) & (gain <= 1)).all()
    assert once.error_models["tracking"].gain == ((1.0, 1.0),) * 3
    assert fit_error_models(once, frames).error_models == once.error_models  # what was believed before does not matter
    # Of each landmark: this toy errs far more at the base, so a median of all would jump between the two kinds.
    errors = [np.nanmedian(evaluate(d, frames).error_px, axis=0) for d in (once, replace(once, closeup_network=None))]
    assert (errors[0] < errors[1] + 0.5).all()


def test_as_much_of_a_correction_is_believed_as_helps():
    """A closeup that overshoots by a known factor and lies off by a known bias; gross errors do not count."""
    rng = np.random.default_rng(1)
    landmark = rng.integers(3, size=3000)
    gain, bias = np.array([[0.2, 0.8], [0.5, 1.0], [0.5, 1.0]]), np.array([[0.3, 0.0], [-0.2, 0.1], [-0.2, 0.1]])
    moved = rng.normal(0, 2, (3000, 2))
    truth = gain[landmark] * moved - bias[landmark] + rng.laplace(0, 0.05, (3000, 2))  # from where it was expected
    errors = moved - truth
    errors[:20], errors[20:40] = 50.0, np.nan
    seen = Seen(np.ones((3000, 3, FEATURES)), errors, np.ones(3000), landmark, moved, np.ones(3000, bool), np.zeros(3000))
    found, off = seen.gain(20.0, np.linspace(0, 1, 51))
    np.testing.assert_allclose(found, gain, atol=0.021)
    np.testing.assert_allclose(off, bias, atol=0.02)
    whole, _ = seen.gain(20.0, [1.0])
    np.testing.assert_array_equal(whole, np.ones((3, 2)))


def test_too_few_landmarks_are_named(small):
    few = small[1][:2]
    with pytest.raises(ValueError, match="to calibrate on"):
        fit_error_models(replace(small[0], error_models={}), few)
    assert fit_error_models(small[0], few, anew=False).error_models == small[0].error_models  # they change nothing
