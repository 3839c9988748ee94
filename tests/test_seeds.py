"""What is said of several seeds together."""

import json

import pytest
from conftest import assert_close

from jaxpend.cli.tables import seeds_table
from jaxpend.files import to_json
from jaxpend.runs.statistics import summary

HEADINGS = {"start": "start", "sac": "after SAC", "snes": "after SNES"}


def results(scores):
    """Results of runs that differ in their seed."""
    return [
        {"robot": "acrobot", "seed": 3 + i, "sac": {"score": score}, "snes": {"score": 0.5}}
        for i, score in enumerate(scores)
    ]


def test_a_summary_keeps_the_seed_axis_and_has_its_statistics(capfd):
    scores = [0.0, 0.5, 0.5, 0.6, 0.6, 0.6, 0.7, 0.9]
    group = summary(results(scores), HEADINGS)
    assert (group["robot"], group["seeds"]) == ("acrobot", [*range(3, 11)])
    assert list(group["stages"]) == ["sac", "snes"]
    found = group["stages"]["sac"]
    assert found["scores"] == scores
    assert_close([found["median"], found["interquartile_mean"]], [0.6, 0.575])  # of 0.5 to 0.6
    assert (found["lowest"], found["highest"]) == (0.0, 0.9)
    low, high = found["interval"]
    assert 0.25 < low < 0.55 < 0.6 < high < 0.75
    assert group["stages"]["snes"]["interval"] == [0.5, 0.5]
    seeds_table(group)
    said = capfd.readouterr().err
    for words in ("8 seeds", "after SAC", "0.6000", "0.5750", f"{low:.4f} to {high:.4f}"):
        assert words in said


def test_one_seed_has_no_interval(capfd):
    group = summary(results([0.25]), HEADINGS)
    assert group["stages"]["sac"]["interval"] is None
    assert group["stages"]["sac"]["interquartile_mean"] == 0.25
    json.loads(to_json(group), parse_constant=pytest.fail)
    seeds_table(group)
    assert "0.2500" in capfd.readouterr().err
