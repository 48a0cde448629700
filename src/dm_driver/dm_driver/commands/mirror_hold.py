"""One holder of the mirror at a time: who it is, and the refusal for everybody else meanwhile. Knows no node.

A calibration is lost if a stray focus request moves the mirror meanwhile. So whoever needs the mirror for a while holds
it: commands of others are refused, with a sentence that says who holds it, for how long, and how to end that. A hold is
renewed regularly and ends soon after its holder has died. Taking it over needs an explicit request.
"""

import threading
from collections.abc import Callable

from dm_msgs.srv import HoldMirror

from dm_common.errors import ErrorCode, Refusal
from dm_common.values import real, text

#: A hold that is not renewed ends after this time, s, unless its holder asked for another lease.
LEASE_S = 3.0
#: Shortest and longest lease that may be asked for, s.
LEASE_MIN_S, LEASE_MAX_S = 0.1, 3600.0
#: Number of holders that are remembered after their hold was taken over.
EVICTED_KEPT = 100

#: Allowed operations: the constants HOLD, RENEW, TAKE_OVER and RELEASE.
Operation = HoldMirror.Request
_OPERATION = text("", choices=("", Operation.HOLD, Operation.RENEW, Operation.TAKE_OVER, Operation.RELEASE))
_DURATION = real(0.0, 0.0, 1e9, "s")
_LEASE = real(0.0, LEASE_MIN_S, LEASE_MAX_S, "s", zero=f"{LEASE_S:g} s, or in a renewal as before")
#: Constraints on `holder` and `purpose`, which appear in every refusal and state.
TEXT = text("")


class MirrorHold:
    """The hold of one mirror, thread-safe. `clock` gives steady time, s; while `lock` is held no hold changes."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.lock = threading.RLock()
        # After its lease has run out, the holder is kept until somebody else moves the mirror: see `holder`.
        self._holder = self._purpose = ""
        self._since = self._until = self._duration = self._lease = 0.0
        self._evicted: dict[str, str] = {}  # whose hold was taken over and by whom, until they hold it again

    @property
    def holder(self) -> str:
        """Who holds the mirror; "" = nobody."""
        with self.lock:
            return self._holder if self._clock() <= self._until else ""

    @property
    def sentence(self) -> str:
        """Who holds the mirror, since when and what for; "" = nobody does."""
        with self.lock:
            if not self.holder:
                return ""
            held = self._clock() - self._since
            left = f", about {self._duration - held:.0f} s to go" if self._duration > held else ""
            purpose = f": {self._purpose}" if self._purpose else ""
            return f"{self._holder} has held the mirror for {held:.0f} s{left}{purpose}; take_over takes it from there"

    def handle(self, operation: str, holder: str, purpose: str = "", duration: float = 0.0, lease: float = 0.0) -> None:
        """Hold the mirror, or give it back, as in dm_msgs/HoldMirror.

        Raises:
            Refusal: BUSY, PREEMPTED when the hold to be renewed was taken over, or a field that is not allowed.
        """
        _OPERATION.check("operation", operation)
        if not holder.strip():
            raise Refusal(ErrorCode.INVALID_ARGUMENT, "holder is empty: must say who holds the mirror")
        TEXT.check("holder", holder)
        TEXT.check("purpose", purpose)
        _DURATION.check("duration", duration)
        _LEASE.check("lease", lease)
        with self.lock:
            current = self.holder
            if operation == Operation.RENEW:
                self._check_evicted(holder)
            if operation == Operation.RELEASE:
                self._evicted.pop(holder, None)  # that run has ended
            if current not in ("", holder) and operation != Operation.TAKE_OVER:
                raise Refusal(ErrorCode.BUSY, self.sentence)
            if operation == Operation.RELEASE:
                if holder == self._holder:
                    self._holder = ""
                return
            again = operation == Operation.RENEW and holder == self._holder  # even if lapsed, when nobody came between
            self._evict(holder, holder)
            self._evicted.pop(holder, None)
            now = self._clock()
            if again:  # empty arguments leave the values as they are
                purpose, duration, lease = purpose or self._purpose, duration or self._duration, lease or self._lease
            elif current != holder:
                self._since = now
            self._holder, self._purpose, self._duration, self._lease = holder, purpose, duration, lease or LEASE_S
            self._until = now + self._lease

    def check(self, holder: str, take_over: bool) -> bool:
        """Whether a command of `holder` ("" = nobody in particular) takes the mirror from another holder.

        Raises:
            Refusal: BUSY, somebody else holds the mirror; PREEMPTED, `holder` lost it and has not held it again.
        """
        with self.lock:
            if not take_over:
                self._check_evicted(holder)
            other = self.holder not in ("", holder)
            if other and not take_over:
                raise Refusal(ErrorCode.BUSY, self.sentence)
            return other

    def evict(self, by: str, take_over: bool = False) -> None:
        """Note that a command of `by` ("" = nobody in particular) is carried out: any other holder loses the mirror.

        So does a holder whose hold has lapsed: the mirror is no longer as it was left, and RENEW must report it.
        """
        with self.lock:
            if take_over:  # it has taken the mirror back
                self._evicted.pop(by, None)
            self._evict(by, by or ("a command with take_over" if self.holder else "a command"))

    def _check_evicted(self, holder: str) -> None:
        if by := self._evicted.get(holder):
            raise Refusal(ErrorCode.PREEMPTED, f"{by} has taken the mirror over")

    def _evict(self, holder: str, by: str) -> None:
        """Note for any other holder than `holder`, even with a lapsed hold, that `by` has taken the mirror over."""
        if self._holder not in ("", holder):
            self._evicted[self._holder], self._holder = by, ""
            if len(self._evicted) > EVICTED_KEPT:
                del self._evicted[next(iter(self._evicted))]
