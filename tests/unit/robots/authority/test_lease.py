"""Leases on one gateway: commands under them, and their end."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

import msgspec
import pytest

from appliance.errors import ConflictError, RefusedError, UnreachableError
from appliance.model import Lease, RobotCommand, encode, keyspace
from appliance.model.robot_api import DriveAsk, RenewAsk, TakeAsk
from appliance.plane.dht import Record
from appliance.robots.authority import lease as module
from appliance.robots.authority.lease import Leasing
from tests.unit.robots.authority.conftest import FakePlane

pytestmark = pytest.mark.anyio


class Gate:
    """Says why commands are refused."""

    why = ""

    def __call__(self, *_: object) -> str:
        """Say it."""
        return self.why


@pytest.fixture
def gate() -> Gate:
    """Return a gate that is open."""
    return Gate()


@pytest.fixture
async def leasing(plane: FakePlane, gate: Gate) -> AsyncIterator[Leasing]:
    """Return the leases of a gateway with one robot."""
    plane.robot("r1")
    it = Leasing(cast("Any", plane), changed=lambda: None, refuses=gate)
    it.start()
    yield it
    await it.close()


async def test_a_soft_stop_binds_whoever_has_the_robot(plane: FakePlane, leasing: Leasing, gate: Gate) -> None:
    """A robot that cannot refuse by itself is sent nothing by the gateway that is asked; the reason is reported."""
    lease = await leasing.take(TakeAsk(robot="r1", by="ann"))
    ask = DriveAsk(robot="r1", lease=lease.id, verb="velocity", args={"forward_mps": 1.0})
    await leasing.move(ask)
    assert plane.told == ["r1", "velocity"]
    gate.why = "stopped by bob"
    with pytest.raises(RefusedError, match="r1 is stopped by bob"):
        await leasing.move(ask)
    assert plane.told == ["r1", "velocity"]


async def test_what_an_operator_orders_is_held_to_the_robots_limits(plane: FakePlane) -> None:
    """What is above a limit is not sent, and the reason is reported."""
    plane.robot("r1")

    def orders(robot: str, command: RobotCommand) -> RobotCommand:
        if command.args.get("forward_mps", 0.0) > 1.0:
            raise RefusedError(f"not sent to {robot}: too fast")
        return command

    leasing = Leasing(cast("Any", plane), changed=lambda: None, refuses=lambda *_: "", orders=orders)
    leasing.start()
    try:
        lease = await leasing.take(TakeAsk(robot="r1", by="ann"))
        with pytest.raises(RefusedError, match="not sent to r1: too fast"):
            await leasing.move(DriveAsk(robot="r1", lease=lease.id, verb="velocity", args={"forward_mps": 2.0}))
        assert plane.told == ["r1"]
        await leasing.move(DriveAsk(robot="r1", lease=lease.id, verb="velocity", args={"forward_mps": 1.0}))
        assert plane.told == ["r1", "velocity"]
    finally:
        await leasing.close()


async def until(holds: Callable[[], bool]) -> None:
    """Wait until it is so."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.005)


def over(leasing: Leasing, ago_s: float = 0.0) -> Lease:
    """Have a lease heard of that was over so long ago."""
    lease = Lease(id="l", robot="r1", by="ann", lease_s=10.0)
    leasing.leases.hear(lease, time.monotonic() - 10.0 - ago_s)
    return lease


async def test_a_robot_holds_before_its_tasks_have_it_again(
    plane: FakePlane, leasing: Leasing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until it has answered that it holds the lease stands, and cannot be renewed; then its end is seen."""
    holds = asyncio.Event()
    query = plane.query

    async def slow(key: str, payload: bytes, *, timeout_s: float, sign: bool, urgent: bool) -> bytes:
        await holds.wait()
        return await query(key, payload, timeout_s=timeout_s, sign=sign)

    monkeypatch.setattr(plane, "query", slow)
    lease = over(leasing)
    await until(lambda: leasing.leases.over("r1"))
    assert leasing.leases.of("r1") == lease
    with pytest.raises(ConflictError, match="has ended"):
        await leasing.renew(RenewAsk(robot="r1", lease="l"))
    assert not plane.puts
    holds.set()
    await until(lambda: leasing.leases.of("r1") is None)
    assert plane.told == ["r1"]
    await until(lambda: plane.puts == [plane.keys(keyspace.LEASE, "r1")])


async def test_where_nobody_tells_its_end_a_lease_ends_after_the_grace(plane: FakePlane, leasing: Leasing) -> None:
    """A gateway that does not own the robot's key waits for the owner's word first."""
    plane.mine = False
    lease = over(leasing)
    await until(lambda: leasing.leases.over("r1"))
    assert leasing.leases.of("r1") == lease
    leasing.leases.hear(Lease(id="l", robot="r1", by="ann", ended="expired"), time.monotonic())
    leasing.leases.hear(Lease(id="m", robot="r1", by="bob"), time.monotonic() - 10.0 - module.GRACE_S)
    await until(lambda: leasing.leases.of("r1") is None)
    assert not plane.told


async def test_what_breaks_does_not_keep_leases_from_ending(plane: FakePlane, leasing: Leasing) -> None:
    """A look that broke is followed by the next one."""
    broke: list[str] = []

    def owns(key: str) -> bool:
        broke.append(key)
        if len(broke) == 1:
            raise RuntimeError("on purpose")
        return True

    plane.owns = owns  # type: ignore[method-assign]
    over(leasing)
    await until(lambda: leasing.leases.of("r1") is None)
    assert len(broke) > 1


async def test_a_robot_is_taken_over_though_nobody_knows_whether_somebody_has_it(
    plane: FakePlane, leasing: Leasing, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The holder of the record is away: the robot is had all the same, and a lease that turns up there is heeded."""
    reads: list[str] = []
    read = plane.read

    async def away(key: str) -> Record | None:
        reads.append(key)
        if len(reads) == 1:
            raise UnreachableError("gw-2 may have it and did not answer")
        return await read(key)

    async def write(key: str, value: bytes, *, expected: dict[str, int] | None) -> dict[str, int]:
        known = plane.records.get(key)
        if (known.version if known is not None else None) != expected:
            raise ConflictError("it has moved on")
        plane.records[key] = Record(key=key, value=value, version={"gw-1": 9})
        return {"gw-1": 9}

    monkeypatch.setattr(plane, "read", away)
    monkeypatch.setattr(plane, "write", write)
    ended = Lease(id="o-1", robot="r1", by="bob", ended="given back")
    plane.records["lease/r1"] = Record(key="lease/r1", value=encode(ended), version={"gw-2": 1})
    lease = await leasing.take(TakeAsk(robot="r1", by="ann"))
    assert msgspec.json.decode(plane.records["lease/r1"].value, type=Lease).id == lease.id
    plane.robot("r2")
    reads.clear()
    held = Lease(id="o-2", robot="r2", by="bob", lease_s=30.0)
    plane.records["lease/r2"] = Record(key="lease/r2", value=encode(held), version={"gw-2": 1})
    with pytest.raises(ConflictError, match="bob"):
        await leasing.take(TakeAsk(robot="r2", by="ann"))
