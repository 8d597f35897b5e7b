"""All verbs of a gateway: behind one queryable, `gw/{gateway}/rpc/*`, among peers, one for each behind a router.

A queryable for each would be some eighty of a gateway, and Zenoh tells every session of each and compares every key
with all of them: with eight gateways on two cores one that was restarted showed its token 30 ms after its session was
open, and 19 ms with one queryable. With 300 members behind one router, though, three of four fleets with one queryable
each never came to rest: some members were seen, but nothing they said was heard (docs/benchmarks.md). Why is not known;
of ten with a queryable for each verb all did. The recorder and other clients of Zenoh see no difference: the keys are
the same.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# The library's stubs leave out the return types of methods that return nothing.

import zenoh

from appliance.errors import UnreachableError
from appliance.plane import link
from appliance.plane.answering import Answering, Handler, Served
from appliance.plane.wire import Closer


class Verbs:
    """The verbs of `expr`, which ends in `/*`; one that is not there is answered as where nobody is."""

    def __init__(self, answering: Answering, expr: str) -> None:
        self._answering = answering
        self._prefix = expr.removesuffix("*")
        self._served: dict[str, Served] = {}
        self._nobody = Served(answering, expr, _nobody)
        self._wrong = Served(answering, self._prefix.removesuffix("/"), _nobody)
        self._closers: list[Closer] = []
        self._one = answering.wire.config.mode == "peer"
        if self._one:
            queryable = answering.wire.raw.declare_queryable(expr, link.callback(self._take), complete=True)
            self._closers.append(Closer(queryable.undeclare))

    def add(self, verb: str, handler: Handler) -> None:
        """Answer a verb from now on."""
        expr = f"{self._prefix}{verb}"
        if self._one:
            self._served[verb] = Served(self._answering, expr, handler)
        else:
            self._closers.append(self._answering.serve(expr, handler))

    def _take(self, query: zenoh.Query) -> None:
        marked, meant = link.read_mark(query)
        key = str(query.key_expr)
        served = self._served.get(key.rpartition("/")[2])
        if served is None:
            # Other clients of Zenoh do not write down what they mean.
            served = self._nobody if not meant or meant == key.encode() else self._wrong
        served.take_marked(query, marked, meant)

    def close(self) -> None:
        """Answer no more."""
        for closer in self._closers:
            closer.close()


async def _nobody(key: str, payload: bytes) -> bytes:
    del payload
    raise UnreachableError(f"nobody answers on {key}", remedy=link.NOBODY_REMEDY)
