"""The order in which fleet events reach their consumers."""

from appliance.plane.events import FactsChanged, FleetEvent, FleetEvents, Joined, Lost, Stage


def test_consumers_are_called_in_the_order_of_their_stages() -> None:
    """Whatever the order in which they subscribed; within a stage the first comes first."""
    events, seen = FleetEvents(), list[str]()
    for name, stage in {"tui": Stage.WATCHERS, "tasks": Stage.TASKS, "facts": Stage.FACTS, "more": Stage.TASKS}.items():
        events.subscribe(stage, lambda _, name=name: seen.append(name))
    events.publish(Joined("gw-2"))
    assert seen == ["facts", "tasks", "more", "tui"]


def test_every_consumer_sees_the_same_sequence() -> None:
    """What the first consumer publishes in reaction is seen by the last one after its cause."""
    events, first, last = FleetEvents(), list[FleetEvent](), list[FleetEvent]()

    def forget(event: FleetEvent) -> None:
        first.append(event)
        if isinstance(event, Lost):
            events.publish(FactsChanged("gateway"))

    events.subscribe(Stage.FACTS, forget)
    events.subscribe(Stage.TASKS, last.append)
    events.publish(Lost("gw-2"))
    assert first == last == [Lost("gw-2"), FactsChanged("gateway")]


def test_a_consumer_that_fails_or_leaves_stops_no_other() -> None:
    """A defect in one consumer is logged; one that has unsubscribed is called no more."""
    events, seen = FleetEvents(), list[FleetEvent]()

    def fail(_: FleetEvent) -> None:
        raise RuntimeError("a defect")

    events.subscribe(Stage.LINKS, fail)
    leave = events.subscribe(Stage.FACTS, seen.append)
    events.subscribe(Stage.TASKS, seen.append)
    events.publish(Joined("gw-2"))
    leave()
    leave()
    events.publish(Lost("gw-2"))
    assert seen == [Joined("gw-2"), Joined("gw-2"), Lost("gw-2")]
