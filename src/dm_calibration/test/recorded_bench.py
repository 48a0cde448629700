"""What a recording holds of a run, for tests of recordings."""

from __future__ import annotations

from collections.abc import Callable

from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.procedure.procedure import Procedure, ProcedureOptions
from dm_calibration.procedure.recorded_run import RecordedRun, plan_text
from hysteretic_mirror import MIRROR, lagging_bench


def recorded(
    kind: PlanKind,
    options: PlanOptions,
    maps_per_state: int = 1,
    failing: frozenset[str] = frozenset(),
    enough: Callable[[Outcome], bool] = lambda outcome: False,
) -> tuple[RecordedRun, Outcome]:
    """A recording, and what the run itself came to; the states `failing` gave no map, `enough` may end it."""
    bench = lagging_bench()
    bench.failing = dict.fromkeys(failing, 99)
    plan = make_plan(kind, MIRROR, options)
    how = ProcedureOptions(maps_per_state=maps_per_state)
    outcome = Procedure(plan, MIRROR, bench, how, enough=enough).run()
    bench.apply(MIRROR.rest)  # as the node does when a run has ended
    return RecordedRun(MIRROR, tuple(bench.moves), tuple(bench.maps), plan_text(kind, options, maps_per_state)), outcome
