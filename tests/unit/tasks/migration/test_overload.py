"""What an overloaded gateway gives away, and when: marks, pauses, rations, and the order of what goes."""

from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import Need, RunRequest
from appliance.tasks.bucket import Bucket
from appliance.tasks.migration.policy import Candidate, Load, Overload, Room, cost_s, may_leave, remaining_s
from appliance.tasks.settings import MigrationConfig

CONFIG = MigrationConfig()
FULL = Load(queue=3, capacity=2)
ROOM = Room(places=10)
RUNS = [Candidate(id=f"r{number}", began=False) for number in range(6)]


def overloaded(config: MigrationConfig = CONFIG, load: Load = FULL) -> Overload:
    """A decider that has seen the load for long enough, at 100 s."""
    made = Overload(config)
    made.look(load, 100.0 - config.above_s - 1.0)
    assert made.look(load, 100.0)
    return made


def choose(
    made: Overload, runs: list[Candidate], now: float = 100.0, load: Load = FULL, room: Room = ROOM
) -> list[str]:
    """What it gives away."""
    return made.choose(load, runs, room, under_way=(), now=now)


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(0.01, 2.0), st.floats(0.0, 1.0), st.integers(0, 3)), min_size=1, max_size=60))
def test_overload_begins_after_a_while_above_and_ends_only_below_the_low_marks(
    steps: list[tuple[float, float, int]],
) -> None:
    """Never before `above_s` on end above a high mark; never over while anything is above its low mark."""
    made, now, above = Overload(CONFIG), 0.0, None
    for pause, cpu, queue in steps:
        now += pause
        was = made.overloaded
        reason = made.look(Load(cpu=cpu, queue=queue), now)
        high = cpu >= CONFIG.cpu_high or queue >= CONFIG.queue_high
        low = cpu < CONFIG.cpu_low and not queue
        above = (above if above is not None else now) if high else None
        if reason and not was:
            assert above is not None
            assert now - above >= CONFIG.above_s
        if was and not reason:
            assert low
        if was and not low:
            assert reason


def test_so_many_go_as_wait_and_those_that_have_not_begun_first() -> None:
    """Three wait: three go, of six; what works already stays."""
    working = [Candidate(id=f"w{number}", elapsed_s=50, expected_s=500, saved=True) for number in range(4)]
    assert choose(overloaded(), [*working, *RUNS]) == ["r0", "r1", "r2"]


def test_those_under_way_count_for_what_must_go() -> None:
    """A queue that is being moved away is not moved twice."""
    assert overloaded().choose(FULL, RUNS[3:], ROOM, under_way=RUNS[:3], now=100.0) == []


def test_processors_are_relieved_down_to_the_middle_of_the_marks() -> None:
    """Four processors at 100 %: 0.6 too many, which two runs of half a processor give."""
    load = Load(cpu=1.0, processors=4.0)
    runs = [Candidate(id=f"r{number}", cpu=0.5, elapsed_s=10, expected_s=100, saved=True) for number in range(6)]
    assert len(choose(overloaded(load=load), runs, load=load)) == 2


def test_what_is_nearly_done_immobile_rested_or_too_dear_stays() -> None:
    """By the experience with its skill, its manifest, its last move, and what a move would throw away."""
    runs = [
        Candidate(id="nearly done", elapsed_s=99, expected_s=100, saved=True),
        Candidate(id="immobile", mobile=False, elapsed_s=1, expected_s=100),
        Candidate(id="resting", elapsed_s=5, expected_s=100, saved=True, moves=1),
        Candidate(id="moved enough", elapsed_s=500, expected_s=2000, saved=True, moves=CONFIG.max_moves),
        Candidate(id="more lost than left", elapsed_s=60, expected_s=100),
        Candidate(id="state dearer than the rest", elapsed_s=1, expected_s=10, saved=True, state_mb=2000),
        Candidate(id="goes", elapsed_s=30, expected_s=100),
    ]
    assert choose(overloaded(), runs) == ["goes"]


def test_a_run_that_takes_twice_as_long_as_others_is_not_nearly_done() -> None:
    """Experience says nothing of it any more: it is expected to take as long again."""
    assert remaining_s(Candidate(id="r", elapsed_s=99, expected_s=100)) == 1
    assert remaining_s(Candidate(id="r", elapsed_s=201, expected_s=100)) == 201
    assert remaining_s(Candidate(id="r", elapsed_s=7)) == 7
    assert cost_s(Candidate(id="r", began=False, elapsed_s=9, state_mb=100)) == 0


def test_who_received_gives_nothing_away_and_who_gave_is_no_target() -> None:
    """For `settle_s` each: nothing is passed on, and nothing comes straight back."""
    made = overloaded()
    made.received(95.0)
    assert choose(made, RUNS) == []
    assert choose(made, RUNS, now=95.0 + CONFIG.settle_s)
    made.gave(200.0)
    made.look(Load(), 200.0)
    assert made.shown(200.0 + CONFIG.settle_s - 0.1)
    assert not made.shown(200.0 + CONFIG.settle_s)


def test_a_run_that_could_not_go_is_left_alone_for_a_while() -> None:
    """Nobody is asked again and again for the same run."""
    made = overloaded()
    made.refused("r0", 100.0)
    assert choose(made, RUNS[:1], now=101.0) == []
    assert choose(made, RUNS[:1], now=100.0 + CONFIG.settle_s) == ["r0"]


@settings(deadline=None)
@given(st.lists(st.floats(0.01, 3.0), min_size=1, max_size=40), st.integers(1, 50), st.integers(0, 8))
def test_moves_are_rationed_whatever_happens(pauses: list[float], overloaded_others: int, places: int) -> None:
    """Never more at once than may be, nor more a second than this gateway's share of the fleet's, nor than room."""
    made, now, given_away = overloaded(), 100.0, 0
    runs = [Candidate(id=f"r{number}", began=False) for number in range(500)]
    load = Load(queue=500, capacity=2)
    room = Room(places=places, overloaded=overloaded_others)
    for pause in pauses:
        now += pause
        made.look(load, now)
        chosen = choose(made, runs, now=now, load=load, room=room)
        assert len(chosen) <= min(CONFIG.at_once, places)
        given_away += len(chosen)
        runs = [each for each in runs if each.id not in chosen]
    rate = min(CONFIG.moves_per_s, CONFIG.fleet_moves_per_s / overloaded_others)
    assert given_away <= CONFIG.moves_per_s + rate * (now - 100.0) + 1


def test_nothing_goes_when_it_is_switched_off_or_there_is_no_room() -> None:
    """`overload = false`, and a fleet that is full."""
    assert choose(overloaded(replace(CONFIG, overload=False)), RUNS) == []
    assert choose(overloaded(), RUNS, room=Room(places=0)) == []


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 5.0), min_size=1, max_size=50))
def test_a_bucket_lets_no_more_through_than_its_rate(pauses: list[float]) -> None:
    """Over any time: the burst and the rate."""
    bucket, now, taken = Bucket(2.0, burst=4.0), 0.0, 0
    for pause in pauses:
        now += pause
        while bucket.take(now):
            taken += 1
    assert taken <= 4 + 2 * now + 1e-6


SENT = RunRequest(task="t-1", subtask="s1", attempt=1, skill="work", need=Need(image="base"), coordinator="gw-1")
OTHERS = {"gw-2", "gw-3"}


def test_a_run_that_may_be_nowhere_else_is_not_offered() -> None:
    """One whose submitter allows this gateway alone stays, however long it waits; so does one that nobody sent."""
    assert may_leave(SENT, "anytime", began=True, others=OTHERS)
    assert may_leave(replace(SENT, group=("gw-1", "gw-3")), "anytime", began=True, others=OTHERS)
    assert not may_leave(replace(SENT, group=("gw-1",)), "anytime", began=False, others=OTHERS)
    assert not may_leave(replace(SENT, coordinator=""), "anytime", began=False, others=OTHERS)
    assert not may_leave(SENT, "never", began=True, others=OTHERS)
    assert may_leave(SENT, "never", began=False, others=OTHERS)


def test_what_works_makes_room_for_what_may_wait_nowhere_else() -> None:
    """Two that may only be here wait: two of those that work go, and the two keep the rations for them."""
    working = [Candidate(id=f"w{number}", elapsed_s=50, expected_s=500, saved=True) for number in range(3)]
    bound = [Candidate(id=f"b{number}", began=False, mobile=False) for number in range(2)]
    full = Load(queue=2, capacity=3)
    assert choose(overloaded(load=full), [*working, *bound], load=full) == ["w0", "w1"]
