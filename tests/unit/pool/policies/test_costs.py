"""What cold starts cost, and images that do not start."""

from appliance.pool.policies import ColdCosts, Quarantine


def test_cold_costs_follow_what_is_measured() -> None:
    """Before the first measurement the configured figure, then the upper part of the recent ones."""
    costs = ColdCosts(500.0, window=4)
    assert costs.of("base") == 500.0
    for took in (100.0, 200.0, 300.0, 400.0):
        costs.add("base", took)
    assert costs.of("base") == 400.0
    for _ in range(4):
        costs.add("base", 50.0)
    assert costs.of("base") == 50.0
    assert costs.of("vision") == 500.0
    assert costs.usual_ms() == 50.0
    costs.add("vision", 150.0)
    assert costs.usual_ms() == 100.0


def test_quarantine() -> None:
    """An image is left alone after so many failures in a row, for a while, and not after a success."""
    quarantine = Quarantine(after=3, for_s=60)
    for _ in range(2):
        quarantine.failed("base", "no such file", 10.0)
    assert quarantine.reason("base", 10.0) == ""
    quarantine.failed("base", "no such file", 11.0)
    assert "3 starts" in quarantine.reason("base", 12.0)
    assert "no such file" in quarantine.reasons(12.0)[0]
    assert quarantine.reason("vision", 12.0) == ""
    assert quarantine.reason("base", 71.0) == ""
    quarantine.failed("base", "again", 72.0)
    assert "again" in quarantine.reason("base", 73.0)
    quarantine.succeeded("base")
    assert quarantine.reasons(73.0) == ()
