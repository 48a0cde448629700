"""Which run a `Calibrate` goal resumes, and when two runs are the same. Independent of ROS."""

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from dm_calibration.calibration import software_version
from dm_calibration.procedure.event_frames import Storing
from dm_calibration.procedure.outcome import Outcome
from dm_calibration.procedure.plan import Plan, PlanKind, PlanOptions
from dm_calibration.procedure.run_journal import Kept, RunJournal
from dm_calibration.procedure.unfinished_runs import UnfinishedRuns
from dm_common.atomic_write import StoreError
from dm_common.figures import counted
from dm_common.mirror import Mirror

#: Free space required for each map, in the journal and then in the calibration [bytes].
ROOM_PER_MAP = 20_000


@dataclass(frozen=True)
class OpenRun:
    """A run with its journal.

    Attributes:
        storing: the calibration that may already have been stored from it; None = the run had not come that far.
        resumed: a sentence if an earlier run is resumed; "" = a new run begins.
        notes: sentences on the fate of other unfinished runs.
    """

    journal: RunJournal
    outcome: Outcome
    storing: Storing | None = None
    resumed: str = ""
    notes: tuple[str, ...] = ()


def mirror_facts(mirror: Mirror) -> dict[str, Any]:
    """Facts, for JSON, by which mirrors and their configurations are distinguished."""
    return {
        "name": mirror.name,
        "serial": mirror.serial,
        "working_radius_m": mirror.working_radius,
        "signal_min": mirror.limits.low,
        "signal_max": mirror.limits.high,
        "neighbour_difference_max": mirror.limits.neighbour_difference,
        "layout_sha256": _hash(mirror.x, mirror.y, mirror.limits.pairs),
    }


def identity_of(
    plan: Plan, options: PlanOptions, mirror: Mirror, settings: Mapping[str, Any], driver: Mapping[str, Any]
) -> dict[str, Any]:
    """Facts in which a goal must agree with an unfinished run to resume it.

    Args:
        settings: of the goal, besides the plan's options.
        driver: facts on wiring, electronics and voltages, from the driver.
    """
    described = [(step.label, step.kind.value, step.dwell) for step in plan.steps]
    signals = [step.signals for step in plan.steps if step.signals is not None]
    steps = hashlib.sha256(json.dumps(described).encode()).hexdigest()
    facts = {
        "plan": plan.kind.name,
        # All other options of the plan are part of its steps.
        "until": options.until,
        "plan_sha256": _hash(*signals) + steps,
        "mirror": mirror_facts(mirror),
        "settings": dict(settings),
        "driver": dict(driver),
    }
    # Through JSON, which turns tuples into lists, as when the facts are read from a file.
    result: dict[str, Any] = json.loads(json.dumps(facts))
    return result


def open_run(
    runs: UnfinishedRuns,
    identity: Mapping[str, Any],
    plan: Plan,
    age_max: float,
    fresh: bool = False,
    now_ns: int = 0,
    maps_per_state: int = 1,
    note: str = "",
) -> OpenRun:
    """Resume the newest unfinished run of the same identity, or begin a new one.

    Args:
        age_max: longest time since the last event of a run that is resumed, s; 0 = resume none.
        fresh: resume none this time.
        now_ns: time of the clock that stamps the maps, ns; 0 = not known.

    Raises:
        StoreError: the journal cannot be written, or there is not enough space for all maps.
    """
    resumable, others = runs.find(identity, plan.remarks)
    notes = [f"unfinished run {text}" for text in others]
    chosen: Kept | None = None
    for found in resumable:
        reason = "a newer one is resumed" if chosen else _reason_against(found, plan, age_max, fresh, now_ns)
        if not reason:
            chosen = found
            continue
        runs.set_aside(found.folder)
        notes.append(f"unfinished run {found.folder.name} ({counted(found.maps, 'map')}) is set aside: {reason}")
    notes += [f"{name} deleted: too many unfinished runs" for name in runs.prune(chosen.folder if chosen else None)]
    about = {"software_version": software_version(), "created_ns": time.time_ns(), "note": note}
    journal = RunJournal.reopen(chosen.folder) if chosen else runs.begin(identity, about)
    try:
        journal.check_room(ROOM_PER_MAP * len(plan.steps) * maps_per_state)
    except StoreError:
        (journal.close if chosen else journal.remove)()
        raise
    if chosen is None:
        return OpenRun(journal, Outcome(remarks=list(plan.remarks)), notes=tuple(notes))
    if chosen.torn:
        notes.append(f"unfinished run {chosen.folder.name}: the last {chosen.torn} bytes are incomplete and ignored")
    text = f"resumed run {chosen.folder.name} with {counted(chosen.outcome.measured, 'map')}"
    return OpenRun(journal, chosen.outcome, chosen.storing, text, tuple(notes))


def _reason_against(found: Kept, plan: Plan, age_max: float, fresh: bool, now_ns: int) -> str:
    """The reason why an unfinished run is not resumed; "" = it is."""
    age = 1e-9 * (time.time_ns() - found.last_ns)
    if fresh:
        return "a fresh run was asked for"
    if not age_max:
        return "resume_max_age = 0"
    if age > age_max:
        return f"it is {age:.0f} s old, resume_max_age is {age_max:.0f} s"
    latest = max((record.stamp_ns for record in found.outcome.records), default=0)
    if plan.kind is PlanKind.HYSTERESIS and now_ns and now_ns < latest:
        return f"the clock is {1e-9 * (latest - now_ns):.0f} s behind its last map: creep needs rising times"
    return ""


def _hash(*arrays: NDArray[Any]) -> str:
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
