"""Verdicts: levels, how they join, and that the workbench knows the same levels."""

import pytest

from lib.trust import LEVELS, Reason, Verdict
from lib.workbench.report import VERDICT_COLOURS

CLOCK = Reason("clock", "not trustworthy", "183 ms", "Set offset_s.")
FEW = Reason("few_frames", "doubtful", "5 frames", "Record more.")


def test_the_worst_reason_decides_and_stands_first():
    joined = Verdict.join([Verdict((FEW,)), Verdict((CLOCK, FEW))])
    assert joined.reasons == (CLOCK, FEW) and joined.level == LEVELS[2] and joined.is_red
    assert joined.to_json()["reasons"][0] == {"name": "clock", "level": LEVELS[2], "text": "183 ms", "cure": "Set offset_s."}
    assert "183 ms" in str(joined)
    with pytest.raises(ValueError, match="level: expected one of"):
        Reason("fine", "trustworthy", "", "")


def test_the_workbench_knows_the_same_levels():
    assert tuple(VERDICT_COLOURS) == LEVELS
