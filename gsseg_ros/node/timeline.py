"""Detects that time was set back, as when a bag loops, and tells that from messages that are merely late."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

SECOND = 1_000_000_000
BEHIND_NS = SECOND
"""How much older than the newest of its stream a message is that is not merely out of order."""

_IN_A_ROW = 10
_WAIT_S = 1.0  # in which nothing goes on; after two, a message is late
MASK = "mask"
"""The stream whose messages are counted where they are lost."""


class Message(NamedTuple):
    """A message of one stream, with its stamp, not yet parsed."""

    stream: str  # "mask", "camera_info", "pose" or "depth"
    stamp: int  # ns
    content: Any
    frame_id: str = ""


class Timeline:
    """Follows the stamps of several streams, and tells which messages came before and after time was set back.

    A stream goes on when it brings a stamp newer than all before. A message is behind if it is a second or more older
    than the newest of its stream. It is held back until it is clear what it is:

    - Late, by however much, if its stream goes on after it, or if two seconds have passed in which another stream went
      on. Late messages belong to the same time as the others.
    - The first of a time that was set back, if every stream is behind that was heard in this time (two at least); if
      ten in a row of camera_info, poses or depth images are behind, which are sent in order, while masks may come from
      several segmenters of different speed; if nothing has gone on for a second; or if /clock was set back
      (`set_back`).

    While one is held, so are others that do not go on: a stream that repeats its stamps may be in the next round of a
    bag. Once time was set back, a stream may still bring stragglers from before: they go on from where the stream was,
    and are a second or more ahead of all that came since.

    At most `capacity` messages are held, and no more of one stream are taken for stragglers.
    """

    def __init__(self, capacity: int) -> None:
        self.epoch = 0  # how often time was set back so far
        self.last_jump = (0, 0)  # from where to where, the last time, ns
        self.lost_masks = 0  # those from before time was set back that came after it
        self._capacity = capacity
        self._newest: dict[str, int] = {}  # Of each stream, in this time.
        self._before: dict[str, int] = {}  # Of the streams that have sent nothing in this time, in the one before.
        self._began = 0  # This time, ns.
        self._stragglers: Counter[str] = Counter()
        self._held: list[Message] = []
        self._behind: Counter[str] = Counter()  # Messages in a row, of those that are held.
        self._held_since: float | None = None
        self._quiet_since: float | None = None
        self._went_on = False  # Anything, while these are held.

    @property
    def held_masks(self) -> int:
        """Number of masks that are held back."""
        return sum(message.stream == MASK for message in self._held)

    @property
    def held_stamps(self) -> set[int]:
        """Stamps of the masks that are held back."""
        return {message.stamp for message in self._held if message.stream == MASK}

    def take_in(self, message: Message) -> list[Message]:
        """Take in a message; return those that can be used now, in order.

        Whoever calls looks at `epoch`: if it has grown, all that came before is to be forgotten first.
        """
        stream, stamp = message.stream, message.stamp
        if stream in self._before:
            if self._is_straggler(message):
                self.lost_masks += stream == MASK
                return []
            del self._before[stream]
        newest = self._newest.setdefault(stream, stamp)
        if stamp > newest:
            return [*self._go_on(stream, stamp), message]
        behind = stamp <= newest - BEHIND_NS
        if not behind and not self._held:
            return [message]
        if not self._held:
            self._held_since, self._quiet_since, self._went_on = None, None, False
        self._held.append(message)
        self._behind[stream] += behind
        return self._judge()

    def set_back(self, stamp: int) -> list[Message]:
        """Take in that the clock was set back to `stamp`; return as `take_in` does.

        If nothing that came is later than that, all streams have shown already that time was set back.
        """
        if max(self._newest.values(), default=stamp) < stamp + BEHIND_NS:
            return []
        before = [message for message in self._held if message.stamp >= stamp + BEHIND_NS]
        self.lost_masks += sum(message.stream == MASK for message in before)
        self._held = [message for message in self._held if message.stamp < stamp + BEHIND_NS]
        return self._start_afresh(stamp)

    def expire(self, now_s: float) -> list[Message]:
        """Judge what has been held long enough; call it some ten times a second.

        Time runs from the first call that finds something held, by a clock that never goes back, such as
        `time.monotonic`.
        """
        if not self._held:
            return []
        self._held_since = now_s if self._held_since is None else self._held_since
        self._quiet_since = now_s if self._quiet_since is None else self._quiet_since
        if now_s - self._quiet_since >= _WAIT_S:
            return self._start_afresh()
        return self._all_late() if now_s - self._held_since >= 2 * _WAIT_S else []

    def forget_masks(self) -> int:
        """Forget the masks that are held; return how many they were."""
        forgotten = self.held_masks
        self._held = [message for message in self._held if message.stream != MASK]
        del self._behind[MASK]
        return forgotten

    def _go_on(self, stream: str, stamp: int) -> list[Message]:
        """Note that a stream went on; return what of it is thereby late."""
        self._newest[stream] = stamp
        self._quiet_since, self._went_on = None, True
        late = [message for message in self._held if message.stream == stream]
        self._held = [message for message in self._held if message.stream != stream]
        del self._behind[stream]
        return late

    def _judge(self) -> list[Message]:
        everywhere = len(self._newest) > 1 and all(self._behind[stream] for stream in self._newest)
        in_a_row = any(count >= _IN_A_ROW for stream, count in self._behind.items() if stream != MASK)
        full = len(self._held) > self._capacity
        if everywhere or in_a_row or (full and not self._went_on):
            return self._start_afresh()
        return self._all_late() if full else []

    def _all_late(self) -> list[Message]:
        """Give up waiting: what is held is late. From there its streams may go on, for it may be they were ahead."""
        late = self._release()
        for stream in {message.stream for message in late if self._behind[message.stream]}:
            self._newest[stream] = max(message.stamp for message in late if message.stream == stream)
        self._behind.clear()
        return late

    def _start_afresh(self, began: int | None = None) -> list[Message]:
        """Begin a new epoch with the messages that are held."""
        first = self._release()
        began = min(message.stamp for message in first) if began is None else began
        self.epoch += 1
        self.last_jump = (max(self._newest.values()), began)
        self._before |= self._newest
        self._began, self._newest = began, {}
        for message in first:
            self._before.pop(message.stream, None)
            self._newest[message.stream] = max(message.stamp, self._newest.get(message.stream, message.stamp))
        self._behind.clear()
        self._stragglers.clear()
        return first

    def _release(self) -> list[Message]:
        released, self._held = self._held, []
        return released

    def _is_straggler(self, message: Message) -> bool:
        went_on = message.stamp > self._before[message.stream] - BEHIND_NS
        ahead = message.stamp >= max(self._newest.values(), default=self._began) + BEHIND_NS
        # Where time was not set back after all, the streams never follow; but only so many messages can be under way.
        self._stragglers[message.stream] += 1
        return went_on and ahead and self._stragglers[message.stream] <= self._capacity
