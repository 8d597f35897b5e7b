"""What must hold of replicas in the end: each breach is found, and a loss by resolution is counted, not blamed."""

from appliance.bench.history.convergence import Copy, Write, check
from appliance.model import VersionVector


def copies(*held: tuple[str | None, VersionVector | None]) -> list[Copy]:
    """Return what replicas hold."""
    return [Copy(gateway=f"g{number}", value=value, version=version) for number, (value, version) in enumerate(held)]


FIRST = Write(value="a", after=None, version={"g0": 1})
SECOND = Write(value="b", after="a", version={"g0": 2})
BESIDE = Write(value="c", after="a", version={"g0": 1, "g1": 1})


def test_replicas_that_agree_on_what_was_written_are_right() -> None:
    """Equal copies of the last acknowledged write, or of one of unknown outcome that followed it, are fine."""
    good = check([FIRST, SECOND], copies(("b", {"g0": 2}), ("b", {"g0": 2})))
    assert good == {"problems": [], "replaced": 0}
    unknown = Write(value="d", after="b")
    assert check([FIRST, SECOND, unknown], copies(("d", {"g0": 3})))["problems"] == []


def test_breaches_are_found() -> None:
    """Different copies, a value that nobody wrote or whose write had failed, a forgotten write, nothing at all."""
    version = {"g0": 2}
    assert "differ" in check([FIRST, SECOND], copies(("b", version), ("a", {"g0": 1})))["problems"][0]
    assert "nobody wrote" in check([FIRST], copies(("z", version)))["problems"][0]
    failed = Write(value="e", after="a", failed=True)
    assert "was not written" in check([FIRST, failed], copies(("e", version)))["problems"][0]
    assert "knows nothing of acknowledged writes: b" in check([FIRST, SECOND], copies(("a", {"g0": 1})))["problems"][0]
    assert "holds nothing" in check([FIRST], copies((None, None)))["problems"][0]


def test_a_write_that_lost_the_resolution_is_counted() -> None:
    """Two owners wrote at once: the result descends from both, one value is replaced, and that is no breach."""
    result = check([FIRST, SECOND, BESIDE], copies(("c", {"g0": 2, "g1": 1})))
    assert result == {"problems": [], "replaced": 1}
