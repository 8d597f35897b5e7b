"""All verbs of a gateway behind one queryable, `{prefix}/*`.

A queryable for each would be some eighty of a gateway, and Zenoh tells every session of each and compares every new key
with all of them: of the processor time until a restarted gateway of eight was linked, the larger part. The recorder and
other clients of Zenoh see no difference: the keys are the same.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# The library's stubs leave out the return types of methods that return nothing.

from collections.abc import Callable

import zenoh

from appliance.errors import UnreachableError
from appliance.plane import link, threads
from appliance.plane.answering import Answering, Handler, Served
from appliance.plane.direct import Answer
from appliance.plane.wire import Closer


class Verbs:
    """The verbs under one prefix; those that are not there are answered as nobody would be."""

    def __init__(self, answering: Answering, prefix: str) -> None:
        self._answering = answering
        self._prefix, self._below = prefix, f"{prefix}/".encode()
        self._served: dict[bytes, Served] = {}
        everything = f"{prefix}/*"
        self._nobody = Served(answering, everything, _nobody)
        self._wrong = Served(answering, prefix, _nobody)
        queryable = answering.wire.raw.declare_queryable(everything, threads.callback(self._take), complete=True)
        self._closers = [Closer(queryable.undeclare)]

    def add(
        self,
        verb: str,
        handler: Handler,
        *,
        direct: bool = False,
        at_once: Callable[[bytes, Answer], bool] | None = None,
    ) -> None:
        """Answer a verb from now on; the rest as of `Session.serve`."""
        served = self._served[verb.encode()] = Served(
            self._answering, f"{self._prefix}/{verb}", handler, at_once=at_once
        )
        if direct:
            self._closers.append(self._answering.take_messages(served))

    def _take(self, query: zenoh.Query) -> None:
        marked, meant = link.read_mark(query)
        # What the asker wrote down is right even where links are mixed up; other clients of Zenoh write nothing.
        key = meant or str(query.key_expr).encode()
        astray = meant and not meant.startswith(self._below)
        served = self._wrong if astray else self._served.get(key.rpartition(b"/")[2], self._nobody)
        served.take_marked(query, marked, meant)

    def close(self) -> None:
        """Answer no more."""
        for closer in self._closers:
            closer.close()


async def _nobody(key: str, payload: bytes) -> bytes:
    del payload
    raise UnreachableError(f"nobody answers on {key}", remedy=link.NOBODY_REMEDY)
