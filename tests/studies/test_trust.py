"""The study of spoiled recordings judges as it says."""

from __future__ import annotations


def test_a_wrong_clock_is_noticed_and_named(run_study):
    found, _ = run_study("spoiled", only="clock")
    assert found["spoiled"] == 4 and found["cause_named_percent"] == 100
    assert found["harmed"] > 0 and found["harmed_trustworthy"] == 0
