"""Acuities as charts name them."""

import pytest

from clients.acuity_text import acuity_text


@pytest.mark.parametrize(
    ("log_mar", "feet", "meters", "decimal", "shown"),
    [  # ISO 8596 and the chart of Ferris et al. 1982
        (1.0, "20/200", "6/60", "0.10", "1.0"),
        (0.5, "20/63", "6/19", "0.32", "0.5"),
        (0.3, "20/40", "6/12", "0.50", "0.3"),
        (0.1, "20/25", "6/7.6", "0.79", "0.1"),
        (0.0, "20/20", "6/6", "1.00", "0.0"),
        (-0.1, "20/16", "6/4.8", "1.26", "\N{MINUS SIGN}0.1"),
        (-0.3, "20/10", "6/3", "2.00", "\N{MINUS SIGN}0.3"),
    ],
)
def test_a_row_is_named_as_on_charts(log_mar, feet, meters, decimal, shown):
    assert acuity_text(log_mar, "feet") == feet
    assert acuity_text(log_mar, "meters") == meters
    assert acuity_text(log_mar, "decimal") == decimal
    assert acuity_text(log_mar, "log_mar") == shown


def test_what_has_no_notation_is_refused():
    with pytest.raises(ValueError, match="log_mar is nan; allowed: finite numbers"):
        acuity_text(float("nan"), "feet")
    with pytest.raises(ValueError, match="notation is 'miles'; allowed: decimal, feet"):
        acuity_text(0.0, "miles")
