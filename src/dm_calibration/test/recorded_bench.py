"""A bench that remembers what was done on it, as a recording does: for tests of recordings."""

from __future__ import annotations

from dataclasses import replace

from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.procedure.procedure import Outcome, Procedure, ProcedureOptions, Progress
from dm_calibration.procedure.recorded_run import Move, RecordedRun
from dm_common.errors import ErrorCode, MeasurementError
from dm_common.measurement import Bench, Measurement
from dm_common.mirror import Mirror
from hysteretic_mirror import MIRROR, lagging_bench
from linear_bench import Floats, LinearBench


class RecordingBench:
    """Passes everything on to `bench` and keeps the driver's and the interferometer's side of it."""

    def __init__(self, bench: LinearBench, failing: frozenset[str] = frozenset()) -> None:
        self._bench, self._failing = bench, failing
        self.moves: list[Move] = []
        self.maps: list[Measurement] = []
        self.labels: dict[int, str] = {}

    def degauss(self) -> None:
        self._bench.degauss()
        self._moved(MIRROR.rest, MIRROR.rest, True)

    def apply(self, signals: Floats) -> Floats:
        applied = self._bench.apply(signals)
        self._moved(signals, applied, False)
        return applied

    def _moved(self, requested: Floats, applied: Floats, degauss: bool) -> None:
        self._bench.clock_ns += 10**8
        self.moves.append(Move(self._bench.clock_ns, requested.copy(), applied.copy(), degauss))

    def settle(self, dwell: float = 0.0, share: float = 1.0) -> bool:
        return self._bench.settle(dwell, share)

    def measure(self, label: str) -> Measurement:
        self._bench.clock_ns += 10**8
        if label in self._failing:
            raise MeasurementError(ErrorCode.MAP_REJECTED, "no new file within 5 s")
        self.maps.append(self._bench.measure(label))
        return replace(self.maps[-1], moved_ns=self.moves[-1].stamp_ns)

    def heard(self, progress: Progress) -> None:
        """Feedback is published at most so often: every second step is told."""
        if progress.done < progress.steps and progress.done % 2 == 0:
            self.labels[progress.done] = progress.label


def recorded(
    kind: PlanKind, options: PlanOptions, maps_per_state: int = 1, failing: frozenset[str] = frozenset()
) -> tuple[RecordedRun, Outcome]:
    """What a recording holds of a run, and what the run itself came to."""
    bench = RecordingBench(lagging_bench(), failing)
    plan = make_plan(kind, MIRROR, options)
    live: Bench = bench
    how = ProcedureOptions(maps_per_state=maps_per_state)
    outcome = Procedure(plan, MIRROR, live, how, progress=bench.heard).run()
    bench.apply(MIRROR.rest)  # as the node does when a run has ended
    mirror: Mirror = MIRROR
    return RecordedRun(mirror, tuple(bench.moves), tuple(bench.maps), bench.labels, len(plan.steps)), outcome
