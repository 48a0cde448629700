"""The report beside each calibration file: written by itself, and never in the way of the calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_parameters import CRITERIA
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.plan import PlanKind, make_plan
from dm_calibration.procedure.procedure import Procedure
from dm_calibration.report.report_writer import ReportWriter
from dm_calibration.store.calibration_store import CalibrationStore
from hysteretic_mirror import lagging_bench
from linear_mirror import make_mirror

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    """Of few actuators, whose report is soon drawn."""
    mirror = make_mirror(rings=1)
    outcome = Procedure(make_plan(PlanKind.POKES, mirror), mirror, lagging_bench(mirror)).run()
    return calibrate(outcome, mirror=mirror, options=FitOptions(), provenance=Provenance("c1", 10**18))


def test_a_stored_calibration_gets_its_report_beside_it(calibration: Calibration, tmp_path: Path) -> None:
    published: list[tuple[str, bool]] = []
    values = CRITERIA | {"updates.stale_after": 7 * 86400.0}
    writer = ReportWriter(lambda text, warning: published.append((text, warning)), values)
    store = CalibrationStore(tmp_path, writer.write)
    store.save(calibration)
    writer.finish()
    assert "<td>valid until</td><td>1970-01-08 " in (tmp_path / "c1.html").read_text()  # measured on the first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c1.h5", "c1.html", "c1.pdf"]
    assert published == [("report written: c1.html and .pdf beside the calibration", False)]
    assert [entry.id for entry in store.entries()] == ["c1"]


def test_a_changed_calibration_gets_a_new_report(calibration: Calibration, tmp_path: Path) -> None:
    writer = ReportWriter(lambda _text, _warning: None)
    store = CalibrationStore(tmp_path, writer.write)
    store.save(calibration)
    store.replace(replace(calibration, limitations=("Somebody leaned on the table.",)))
    writer.finish()
    assert "Somebody leaned on the table." in (tmp_path / "c1.html").read_text()


def test_a_report_that_fails_leaves_the_calibration_and_a_sentence(calibration: Calibration, tmp_path: Path) -> None:
    published: list[tuple[str, bool]] = []
    writer = ReportWriter(lambda text, warning: published.append((text, warning)))
    (tmp_path / "c1.html").mkdir()  # something else has the name
    store = CalibrationStore(tmp_path, writer.write)
    store.save(calibration)
    writer.finish()
    ((text, warning),) = published
    assert warning and text.startswith("no report of c1.h5: ") and "./dm report" in text
    assert store.load("c1").id == "c1"


def test_a_store_tells_of_every_file_that_it_writes(calibration: Calibration, tmp_path: Path) -> None:
    written: list[Path] = []
    store = CalibrationStore(tmp_path, written.append)
    store.save(calibration)
    store.replace(calibration)
    assert written == 2 * [tmp_path / "c1.h5"]
    assert [path.name for path in tmp_path.iterdir()] == ["c1.h5"]


def test_the_end_of_the_node_leaves_no_halves(calibration: Calibration, tmp_path: Path) -> None:
    writer = ReportWriter(lambda _text, _warning: None)
    CalibrationStore(tmp_path, writer.write).save(calibration)
    writer.end()
    assert {path.name for path in tmp_path.iterdir()} <= {"c1.h5", "c1.html", "c1.pdf"}
