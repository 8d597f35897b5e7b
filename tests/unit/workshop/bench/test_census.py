"""What counts before and after say of leaks and memory."""

from workshop.bench.soak import Census, compare


def test_what_comes_back_to_where_it_was_is_no_leak() -> None:
    """Equal counts, and memory that grows only while caches fill, are flat."""
    counts = [
        Census(runs=0, containers=4, conmon=4, descriptors=35, tasks=12, rss_mb=70.0),
        Census(runs=400, containers=4, conmon=4, descriptors=36, tasks=13, rss_mb=90.0),
        Census(runs=1000, containers=4, conmon=4, descriptors=36, tasks=13, rss_mb=91.0),
    ]
    found = compare(counts)
    assert found["leaks"] == {}
    assert (found["rss_growth_mb"], found["rss_growth_from_runs"], found["flat"]) == (1.0, 400, True)


def test_leaks_are_named_and_counted() -> None:
    """A monitor more, or descriptors beyond what threads may hold, are leaks; memory that keeps growing is reported."""
    counts = [
        Census(runs=0, containers=4, conmon=4, descriptors=35, rss_mb=70.0),
        Census(runs=500, containers=4, conmon=4, descriptors=85, rss_mb=90.0),
        Census(runs=1000, containers=4, conmon=5, descriptors=135, rss_mb=110.0),
    ]
    found = compare(counts)
    assert found["leaks"] == {"conmon": 1, "descriptors": 100}
    assert (found["rss_growth_mb"], found["flat"]) == (20.0, False)
