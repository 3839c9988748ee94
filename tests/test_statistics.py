"""The interquartile mean over seeds and its bootstrap interval."""

import numpy as np

from jaxpend.runs.statistics import interquartile_mean, interval


def test_the_interquartile_mean_leaves_out_the_lowest_and_the_highest_quarter():
    assert interquartile_mean([100.0, 2.0, 1.0, -7.0]) == 1.5
    np.testing.assert_array_equal(interquartile_mean([[1.0, 10.0], [3.0, 20.0]]), [2, 15])


def test_the_interval_holds_the_mean_and_narrows_with_seeds():
    rng = np.random.default_rng(1)
    few, many = rng.normal(5, 1, size=(6, 50)), rng.normal(5, 1, size=(96, 50))
    for values in (few, many):
        low, high = interval(values)
        assert low.shape == high.shape == (50,)
        mean = interquartile_mean(values)
        assert ((low < mean) & (mean < high)).all()
    # As the square root of the number of seeds: a factor of 4.
    widths = [np.mean(high - low) for low, high in (interval(few), interval(many))]
    assert 3 < widths[0] / widths[1] < 5


def test_one_seed_or_equal_seeds_have_no_width():
    assert interval([0.3]) == (0.3, 0.3)
    assert interval([0.5, 0.5, 0.5]) == (0.5, 0.5)
