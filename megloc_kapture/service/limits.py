"""Limits of what one client may ask of a service, and who is next.

Work waits in a line for each client, and the lines take turns: who sends a hundred images delays
another client's by one of them.
"""

from __future__ import annotations

import asyncio
import ipaddress
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable

from pydantic import Field

from megloc_kapture.values import Options


class Limits(Options):
    """What a service takes; of each worker process."""

    threads: int | None = Field(
        default=None,
        ge=1,
        description="Images that a process localizes at once; unless given, the cores divided by "
        "the workers.",
    )
    max_waiting: int = Field(
        default=32, ge=1, description="Images that may wait; half of them of one client."
    )
    max_mb: float = Field(default=20.0, gt=0, description="Size of a request.")
    max_megapixels: float = Field(default=32.0, gt=0, description="Size of an image.")
    requests_per_minute: float = Field(
        default=120.0, ge=0, description="Requests of one client; 0: no limit."
    )
    time_limit_s: float = Field(default=60.0, gt=0, description="Time to wait and to localize in.")
    upload_limit_s: float = Field(default=30.0, gt=0, description="Time for a request to come in.")


class Busy(Exception):
    """The lines are full."""


class Turns:
    """Slots that clients take in turn.

    One slot more is kept for clients that have none: long work of others does not stop them. A
    client's line may have half of all that wait, so that nobody fills it alone. To be used from one
    event loop.

    Parameters
    ----------
    slots : what may be taken at once, but for that one.
    max_waiting : of all lines together.
    """

    def __init__(self, slots: int, max_waiting: int) -> None:
        self._slots, self._max_waiting = slots, max_waiting
        self._taken: Counter[str] = Counter()
        self._lines: OrderedDict[str, deque[asyncio.Future[None]]] = OrderedDict()

    @property
    def taken(self) -> int:
        """Slots that are taken."""
        return self._taken.total()

    @property
    def waiting(self) -> int:
        """How many wait."""
        return sum(map(len, self._lines.values()))

    async def take(self, client: str) -> None:
        """Wait for a slot, which is to be given back; raises Busy."""
        line = self._lines.setdefault(client, deque())
        try:
            if not line and self._may_take(client):
                self._taken[client] += 1
                return
            if self.waiting >= self._max_waiting or len(line) >= (self._max_waiting + 1) // 2:
                raise Busy
            turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            line.append(turn)
            try:
                await turn
            except asyncio.CancelledError:
                if turn in line:
                    line.remove(turn)
                elif not turn.cancelled():
                    self.give_back(client)  # it came as we left
                raise
        finally:
            if not line and self._lines.get(client) is line:
                del self._lines[client]

    def give_back(self, client: str) -> None:
        """Give a slot back; the next client that waits gets it."""
        self._taken[client] -= 1
        if not self._taken[client]:
            del self._taken[client]
        for other, line in self._lines.items():
            while line and self._may_take(other):
                turn = line.popleft()
                if not turn.done():  # cancelled
                    self._taken[other] += 1
                    self._lines.move_to_end(other)
                    turn.set_result(None)
                    return

    def _may_take(self, client: str) -> bool:
        return self.taken < self._slots + (client not in self._taken)


class Rates:
    """Requests per minute of each client: a bucket that fills evenly and holds a minute's worth.

    Parameters
    ----------
    per_minute : 0: no limit.
    clock : seconds.
    """

    _MAX_CLIENTS = 10_000

    def __init__(self, per_minute: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._most = per_minute / 60.0, max(per_minute, 1.0)
        self._clock = clock
        # client -> what was left in its bucket, and when; that of the longest silence first
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, client: str) -> float:
        """Count a request; how long the client has to wait before it may send one, 0 for now."""
        if not self._per_s:
            return 0.0
        now = self._clock()
        left, then = self._left.pop(client, (self._most, now))
        left = min(self._most, left + (now - then) * self._per_s)
        wait_s = 0.0 if left >= 1.0 else (1.0 - left) / self._per_s
        self._left[client] = left - (wait_s == 0.0), now
        while len(self._left) > self._MAX_CLIENTS:
            self._left.popitem(last=False)
        return wait_s


def client_of(address: str | None) -> str:
    """What clients are told apart by: their address, of IPv6 the network of 64 bits."""
    try:
        found = ipaddress.ip_address((address or "").partition("%")[0])
    except ValueError:
        return ""
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)
