"""The report of a calibration: what is in it, and that its figures are those of the calibration."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from dm_msgs.msg import Capabilities
from reportlab.pdfbase.pdfmetrics import stringWidth
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import LongTable, Paragraph
from scipy.optimize import linprog
from scipy.stats import theilslopes

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_messages import calibration_message
from dm_calibration.calibration_parameters import CRITERIA
from dm_calibration.calibrator import Provenance, calibrate
from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.influence.fit import FitOptions
from dm_calibration.procedure.plan import PlanKind, PlanOptions, make_plan
from dm_calibration.procedure.procedure import Procedure, ProcedureOptions
from dm_calibration.recalibration.check_log import Check, append_check
from dm_calibration.recalibration.drift import UpdateOptions
from dm_calibration.recalibration.update_storage import write_updates
from dm_calibration.recalibration.updates import SUFFIX, RecalibrationManager
from dm_calibration.report import content, content_hysteresis
from dm_calibration.report.certificate import certificate, keep_people, people, spheres
from dm_calibration.report.checks import valid_until
from dm_calibration.report.content_fit import residuals
from dm_calibration.report.content_hysteresis import loop_opening, step_response
from dm_calibration.report.document import Section, Table
from dm_calibration.report.figures import response_figure
from dm_calibration.report.html_page import html_page
from dm_calibration.report.page import figures_of, sections, write_report
from dm_calibration.report.pdf_pages import pdf_pages
from dm_calibration.store.calibration_store import CalibrationStore
from dm_common import Floats
from dm_common.hysteresis.model import REQUEST_ERROR_RATIO, HysteresisModel
from dm_common.optics.conic import conic_coefficients, range_text
from dm_common.optics.piston_tilt import rms
from dm_common.recipes import Recipe, RecipeBook
from hysteretic_mirror import MIRROR, lagging_bench
from linear_mirror import make_mirror
from recorded_bench import recorded

pytestmark = pytest.mark.slow

#: One play operator of half-width 0.2 and weight 1 beside the signal: the loop opens by 2 x 0.2 of a span of 2 + 1.6.
PLAY = HysteresisModel(
    np.array([0.0, 0.2]), np.array([[1.0], [1.0]]), np.zeros(0), 0.0, 0.01, np.geomspace(0.03, 3e5, 15)
)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    _run, outcome = recorded(PlanKind.FULL, PlanOptions(), failing=frozenset({"poke+03"}))
    provenance = Provenance("bench_3", 1_700_000_000 * 10**9, "cold <morning> & windy")
    made = calibrate(outcome, mirror=MIRROR, options=FitOptions(), provenance=provenance)
    return replace(made, maps=replace(made.maps, stamp_ns=made.maps.stamp_ns + provenance.created_ns))


@pytest.fixture(scope="module")
def page(calibration: Calibration, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("report")
    file = CalibrationStore(folder).save(calibration)
    html, pdf = write_report(calibration, folder / "out", file)
    assert pdf.read_bytes().startswith(b"%PDF")
    assert sorted(path.name for path in (folder / "out").iterdir()) == ["bench_3.html", "bench_3.pdf"]
    text = html.read_text()
    assert hashlib.sha256(file.read_bytes()).hexdigest() in text
    return text


def test_a_mirror_of_nineteen_actuators_has_a_report(tmp_path: Path) -> None:
    mirror = make_mirror(rings=2)
    plan = make_plan(PlanKind.POKES, mirror, PlanOptions())
    outcome = Procedure(plan, mirror, lagging_bench(mirror), ProcedureOptions()).run()
    small = calibrate(outcome, mirror=mirror, options=FitOptions(), provenance=Provenance("small", 10**18))
    html, pdf = write_report(small, tmp_path, CalibrationStore(tmp_path).save(small))
    text = html.read_text()
    actuators = text[text.index("<caption>Actuators") :]
    assert re.findall(r"<tr><td>(\d+)</td>", actuators[: actuators.index("</table>")]) == [
        str(k + 1) for k in range(19)
    ]
    assert "<td>actuators</td><td>19 good</td>" in text
    assert pdf.stat().st_size > 10_000


def test_the_axis_of_a_single_actuator_numbers_it() -> None:
    mirror = make_mirror(rings=0)
    outcome = Procedure(make_plan(PlanKind.POKES, mirror), mirror, lagging_bench(mirror)).run()
    one = calibrate(outcome, mirror=mirror, options=FitOptions(), provenance=Provenance("one", 10**18))
    np.testing.assert_array_equal(np.mod(response_figure(one).axes[0].get_xticks(), 1.0), 0.0)


def test_a_text_longer_than_a_page_is_printed_and_a_long_title_ends_before_the_page_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    feet = list[str]()
    monkeypatch.setattr(Canvas, "drawString", lambda _canvas, _x, _y, text: feet.append(text))
    table = Table("Provenance", ("item", "value"), [("note", "word " * 2000)], textual=True)
    assert pdf_pages("A mirror with a name " * 20, [Section("What was measured", [], [table])]).startswith(b"%PDF")
    assert len(feet) > 1 and all(stringWidth(foot, "DejaVuSans", 7.0) < 430.0 for foot in feet)


def test_the_page_is_one_file(page: str) -> None:
    images = re.findall(r'<img src="([^"]{30})', page)
    assert len(images) == 5
    assert all(source.startswith("data:image/png;base64,") for source in images)
    assert not re.search(r"https?://|\bnan\b", page)


def test_the_page_says_what_was_measured_and_how_well(page: str, calibration: Calibration) -> None:
    for text in ("PDM30-37, serial", "22.000 mm", "632.80 nm", "cold &lt;morning&gt; &amp; windy", "2023-11-14"):
        assert text in page
    fit = calibration.fit
    assert f"<td>{fit.in_sample_rms * 1e9:.2f} nm (λ/{calibration.wavelength / fit.in_sample_rms:.0f})</td>" in page
    assert f"<td>{fit.held_out_rms * 1e9:.2f} nm (λ/{calibration.wavelength / fit.held_out_rms:.0f})</td>" in page


def test_the_page_names_what_was_dropped_and_every_limitation(page: str, calibration: Calibration) -> None:
    assert "<tr><td>poke+03</td><td>no map within 5 s (2 tries)</td></tr>" in page
    text = page.replace("&#x27;", "'")
    assert "held out, 95 % of the maps, with what hysteresis may add" in page
    for sentence in calibration.limitations:
        assert sentence.removeprefix("Poke check: ") in text
    assert "Not identified" in page


def test_the_first_page_is_a_certificate(page: str, calibration: Calibration) -> None:
    first = page[page.index("<h2>Certificate") : page.index("<h2>Every actuator")]
    assert "approximate: the promise is above 32 nm" in first and "<img " in first
    assert f"{calibration.fit.held_out_max_zernike * 1e9:.2f} nm" in first and "95 % bound" in first
    assert "2023-12-14" in first, "valid for thirty days"
    low, high, predicted = spheres(calibration)
    assert predicted < 1e-11 and "within 0.01 nm for half" in first and "of what is predicted in every" in first
    assert -0.3 < low < -0.2 and 0.2 < high < 0.3 and range_text(low, high, "1/m", 3) in first
    assert '<th scope="col">SHA' not in page[: page.index("<h2>Files")]


def test_a_mirror_that_is_only_pulled_has_a_range(calibration: Calibration) -> None:
    """Its figure is a bowl, deeper than its signals can flatten."""
    fit = calibration.fit
    low, high, predicted = spheres(calibration)
    bowl = np.where(np.arange(21) == 3, 12e-6, 0.0)
    pulled = replace(calibration, fit=replace(fit, zernike_offset=fit.zernike_offset + bowl))
    shift = 4.0 * 12e-6 / calibration.aperture_radius**2
    assert low + shift > 0.0 and spheres(pulled) == pytest.approx((low + shift, high + shift, predicted), abs=2e-3)


def test_every_coefficient_of_a_sphere_in_the_range_can_be_reached(calibration: Calibration) -> None:
    """A linear programme finds signals for the range told, and none for one that is 2 % wider."""
    fit, (low, high, _predicted) = calibration.fit, spheres(calibration)
    terms, offset = fit.influence_zernike[3:] * 1e6, fit.zernike_offset[3:] * 1e6
    for curvature, within in ((low, True), (high, True), (1.02 * low, False), (1.02 * high, False)):
        wanted = 1e6 * conic_coefficients(curvature, 0.0, calibration.aperture_radius)[3:] - offset
        bounds = np.concatenate((wanted + 0.02, 0.02 - wanted))
        found = linprog(np.zeros(37), np.vstack((terms, -terms)), bounds, bounds=(fit.signal_min, fit.signal_max))
        assert found.success is within, curvature


def test_what_few_actuators_leave_of_every_sphere_is_told(calibration: Calibration) -> None:
    """Without the outer ring no signals make all coefficients right."""
    fit, inner = calibration.fit, np.arange(37) < 19
    few = replace(fit, influence_zernike=fit.influence_zernike * inner, influence_sag=fit.influence_sag * inner)
    assert spheres(calibration)[2] < 1e-9
    low, high, predicted = spheres(replace(calibration, fit=few))
    assert low < high and 1e-9 < predicted < 20e-9


def test_a_calibration_made_of_old_maps_is_no_longer_valid_for_that(calibration: Calibration) -> None:
    again = replace(calibration, created_ns=calibration.created_ns + 10**9 * 86400 * 300)
    assert "2023-12-14" in html_page("", [certificate(again, {})])


def test_a_figure_that_asks_too_much_of_neighbours_does_not_put_flat_out_of_reach(calibration: Calibration) -> None:
    """A bump over one actuator, a little higher than it may stand away from its neighbours: these share the rest."""
    fit = calibration.fit
    bump = replace(fit, zernike_offset=0.25 * fit.influence_zernike[:, 0], sag_offset=0.25 * fit.influence_sag[:, 0])
    applied = np.zeros_like(calibration.maps.applied)
    applied[:, 0] = 0.2
    low, high, _predicted = spheres(replace(calibration, fit=bump, maps=replace(calibration.maps, applied=applied)))
    assert low < -0.01 and high > 0.01


def test_a_good_calibration_is_called_so_and_names_are_kept(calibration: Calibration, tmp_path: Path) -> None:
    file = tmp_path / "people.json"
    keep_people({"operator": "A. N. Other", "instrument": ""}, file)
    keep_people({"instrument": "Verifire"}, file)
    keep_people({}, file)
    hysteresis = HysteresisFit("Prandtl-Ishlinskii", PLAY, np.full(21, 1e-9), 2e-9, 0.05, 120, ())
    text = html_page("", [certificate(replace(calibration, hysteresis=hysteresis), people(file))])
    for expected in ("<td>calibrated</td>", "2.80 nm (λ/226), 95 % bound", "A. N. Other", "Verifire"):
        assert expected in text
    assert "absolute not known (instrument_error and scale_error of the interferometer not given)" in text
    known = replace(calibration, reference_surface="flat.dat, SHA-256 01", instrument_error=5e-9, scale_error=1e-4)
    absolute = html_page("", [certificate(known, {})])
    assert "flat.dat, SHA-256 01" in absolute and " nm, limited by" in absolute.partition("absolute to ")[2][:20]
    dead = replace(calibration.fit, grades=np.array([2] + [0] * 36, dtype=np.uint8))
    assert "actuator 1 is dead" in replace(calibration, fit=dead).doubts()[0]
    assert people(tmp_path / "none.json") == {}


@pytest.mark.parametrize(
    ("grade", "promised", "error_max", "good"),
    [(1, 20e-9, 32e-9, True), (2, 20e-9, 32e-9, False), (0, 40e-9, 32e-9, False), (0, 40e-9, 50e-9, True)],
)
def test_message_and_certificate_agree(
    calibration: Calibration, grade: int, promised: float, error_max: float, good: bool
) -> None:
    """Of weak actuators, without a law of hysteresis, and by the limit that is configured."""
    grades = np.array([grade] + [0] * 36, dtype=np.uint8)
    judged = replace(calibration, fit=replace(calibration.fit, grades=grades, held_out_max_zernike=promised))
    message = calibration_message(judged, None, "mirror", error_max)
    values = CRITERIA | {"calibrated_error_max": error_max}
    assert (message.quality == Capabilities.CALIBRATED) is good
    assert ("<td>calibrated</td>" in html_page("", [certificate(judged, {}, (), values)])) is good


def test_the_certificate_says_what_checks_have_shown_since(calibration: Calibration, tmp_path: Path) -> None:
    """It promised the range and the accuracy of all actuators after one of them was given up."""
    file = CalibrationStore(tmp_path).save(calibration)
    updates = RecalibrationManager(tmp_path, UpdateOptions)
    updates.begin(calibration)
    assert updates.in_use is not None
    drift = updates.in_use.drift
    drift = replace(drift, stuck=np.where(np.arange(37) == 4, -1.0, drift.stuck), surprising=3)
    write_updates(tmp_path / f"{calibration.id}{SUFFIX}", calibration, drift)
    first = html_page("", sections(calibration, file)[:1])
    for expected in (
        "approximate:",
        "calibrate again; Used without actuator 5 (fixed at -1.00)</td>",
        "./dm status",
    ):
        assert expected in first
    patient = html_page("", sections(calibration, file, CRITERIA | {"updates.surprises_max": 4})[:1])
    assert "calibrate again" not in patient and "Used without actuator 5" in patient


def checks_of(calibration: Calibration, growth: float, count: int = 8) -> list[Check]:
    """A check every three days, whose error grows by `growth`, m a day."""
    start, days = calibration.stamp_ns * 1e-9, 3.0 * np.arange(1, count + 1)
    scatter = 1e-10 * np.random.default_rng(0).standard_normal(count)
    return [
        Check(start + 86400.0 * day, 1, 1e-9 + growth * day + more, 1e-9, 1.0, 1e-3, 4, 2e-10 * day)
        for day, more in zip(days, scatter, strict=True)
    ]


def test_checks_say_what_drifts_and_until_when_it_is_valid(calibration: Calibration, tmp_path: Path) -> None:
    held_out = 5e-9 / REQUEST_ERROR_RATIO
    known = replace(calibration, hysteresis=HysteresisFit("Preisach", PLAY, np.full(21, 1e-9), held_out, 0.05, 120, ()))
    start = known.stamp_ns * 1e-9
    # From 1 nm by 0.1 nm a day to 5 nm: 40 days; without growth thirty days after the last check that agreed.
    for growth, days, reason in (
        (1e-10, 40.0, "the error grows by +3"),
        (5e-11, 24 + 30.0, "within the promise until then"),
        (0.0, 24 + 30.0, "no growth"),
    ):
        until, text = valid_until(checks_of(known, growth), 5e-9, start)
        assert (until - start) / 86400.0 == pytest.approx(days, abs=3.0) and reason in text
    assert "nm" not in valid_until(checks_of(known, -1e-10), 5e-9, start)[1]  # the slope of chance means nothing
    assert "too few checks" in valid_until(checks_of(known, 1e-10, 3), 5e-9, start)[1]
    for check in checks_of(known, 1e-10):
        append_check(tmp_path / f"{known.id}.checks.csv", check)
    file = CalibrationStore(tmp_path).save(known)
    page = write_report(known, tmp_path / "out", file)[0].read_text()
    section = page[page.index("<h2>Checks since") : page.index("<h2>Summary")]
    assert "8 maps were compared" in section and "0.10% (4)" in section and "Valid until 2023-12-2" in section
    term = section.partition("Valid until ")[2].partition(".</p>")[0]
    assert "the error grows by" in term and f"<td>valid until</td><td>{term}</td>" in page  # the certificate's
    assert section.count("<img ") == 1


def test_a_log_of_very_many_checks_has_a_trend(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of an instrument that measures continuously: the slopes of all pairs would not fit into memory."""
    seen: list[float] = []

    def slopes(error: Floats, time: Floats, share: float) -> object:
        seen.extend(time)
        return theilslopes(error, time, share)

    monkeypatch.setattr(scipy.stats, "theilslopes", slopes)
    checks = [Check(60.0 * k, 1, 1e-9 + 1e-14 * k, 1e-9, 1.0, 0.0, 1, 0.0) for k in range(100_000)]
    assert "the error grows by +0.43 nm in 30 days" in valid_until(checks, 5e-9, 0.0)[1]
    assert len(seen) == 500 and max(seen) - min(seen) == pytest.approx(6e6, rel=0.01)


@pytest.mark.parametrize("lines", range(0, 60, 4))
def test_headings_stay_with_what_is_below_them(lines: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """However far down a page it begins, a heading is on the page of its table."""
    pages: dict[str, int] = {}

    def recorded_draw(kind: type, name: Callable[[Any], str]) -> None:
        original = kind.draw  # type: ignore[attr-defined]

        def draw(flowable: Any) -> None:
            pages.setdefault(name(flowable), flowable.canv.getPageNumber())
            original(flowable)

        monkeypatch.setattr(kind, "draw", draw)

    recorded_draw(Paragraph, lambda paragraph: paragraph.text)
    recorded_draw(LongTable, lambda _table: "rows")
    table = Table("Its table", ("item", "value"), [(f"row {k}", str(k)) for k in range(12)])
    sheets = [Section("Sheet", ["much"] * (40 + lines), sheet=True), Section("Other sheet", ["little"], sheet=True)]
    pdf_pages("", [*sheets, Section("Filler", ["filler"] * lines), Section("The heading", ["Some words."], [table])])
    assert (pages["Sheet"], pages["much"], pages["Other sheet"]) == (1, 1, 2), "as much as there is: it fits on a page"
    assert pages["Filler"] == 3
    assert pages["The heading"] == pages["Its table"] == pages["rows"] <= 5


def test_every_map_has_a_row(page: str, calibration: Calibration) -> None:
    rows = page[page.index("<caption>Maps in the order measured") :]
    for label in calibration.maps.label:
        assert f"<td>{label}</td>" in rows


def test_a_command_without_a_map_has_no_number_and_is_dropped_once(calibration: Calibration) -> None:
    """A hysteresis run keeps it: it belongs to the history of the actuators."""
    lost, maps = np.arange(len(calibration.maps)) == 5, calibration.maps
    without = replace(
        maps,
        coefficients=np.where(lost[:, None], np.nan, maps.coefficients),
        sag=np.where(lost[:, None], np.nan, maps.sag),
        residual_rms=np.where(lost, np.nan, maps.residual_rms),
        valid_fraction=np.where(lost, 0.0, maps.valid_fraction),
    )
    said = "a Zernike coefficient is not finite"
    reasons = tuple(said if one else reason for one, reason in zip(lost, calibration.fit.reasons, strict=True))
    fit = replace(calibration.fit, used=calibration.fit.used & ~lost, reasons=reasons)
    dropped = (*calibration.dropped, f"{maps.label[5]}: no map within 5 s")
    whole = replace(calibration, maps=without, fit=fit, dropped=dropped)
    (table,) = content.every_map(whole).tables
    assert tuple(table.rows[5])[3:] == ("dropped", "no map", "0.0")
    assert whole.maps_dropped == calibration.maps_dropped + 1, "it is counted once"
    (left_out,) = content.cautions(whole).tables
    assert [row for row in left_out.rows if row[0] == maps.label[5]] == [(maps.label[5], "no map within 5 s")]
    measured, provenance = len(maps) - 1, content.provenance(whole).tables[0]
    counts = {name: value for name, value in provenance.rows if name.startswith("maps")}
    assert counts["maps in the fit"] == f"{int(fit.used.sum())} of {measured}"
    assert sum(int(part.split()[0]) for part in counts["maps"].split(", ")) == measured
    assert f": {measured} maps, " in repr(whole)


def test_counts_read_as_a_sentence(calibration: Calibration) -> None:
    clean = replace(
        calibration,
        dropped=(),
        limitations=(),
        fit=replace(calibration.fit, used=np.ones(len(calibration.maps), dtype=bool)),
    )
    assert content.summary(clean).paragraphs[-1] == "No map was dropped; no warning or limitation below."


def test_residuals_are_those_of_the_fit(calibration: Calibration) -> None:
    left = residuals(calibration)
    expected = calibration.fit.map_residual[calibration.fit.used]
    np.testing.assert_allclose(rms(left.sag, left.points.weight), expected, rtol=1e-6)


def test_hysteresis_and_recipes_are_shown(calibration: Calibration) -> None:
    hysteresis = HysteresisFit("Prandtl-Ishlinskii", PLAY, np.full(21, 1e-9), 2e-9, 0.05, 120, ("Chosen of four.",))
    astigmatism = (*4 * (0.0,), 2e-7, *16 * (0.0,))
    recipe = Recipe(0.02, -1.0, np.zeros(37), np.full(37, 0.1), 0.6e-9, 1.2e-9, 4, astigmatism, stamp_ns=10**18)
    whole = replace(calibration, hysteresis=hysteresis, recipes=RecipeBook((recipe,), 100, 0.8e-9))
    made = [content.summary(whole), content_hysteresis.hysteresis(whole), content_hysteresis.recipes(whole)]
    text = html_page("", made)
    for expected in (
        "11.1% of the span",
        "1.00% of a step per decade",
        "Chosen of four.",
        "<td>+0.0200</td>",
        "0.60",
        "+200 nm",
    ):
        assert expected in text
    assert text.count("<img ") == 3
    figures = figures_of(whole)
    assert figures["hysteresis"]["law"] == "Prandtl-Ishlinskii"
    assert figures["remeasured_max_zernike_nm"] == pytest.approx(0.6)


def test_a_play_operator_opens_the_loop_by_its_width() -> None:
    assert loop_opening(PLAY, -1.0, 1.0) == pytest.approx(0.4 / 3.6)
    assert loop_opening(HysteresisModel.linear(), -1.0, 1.0) == pytest.approx(0.0, abs=1e-12)


def test_actuators_with_laws_of_their_own_have_loops_of_their_own(calibration: Calibration) -> None:
    share = np.linspace(0.5, 1.5, 37)
    own = replace(PLAY, play_weight=np.array([1.0, 0.0])[:, None] + share[:, None, None] * [[0.0], [1.0]])
    np.testing.assert_allclose(loop_opening(own, -1.0, 1.0), 0.4 * share / (2.0 + 1.6 * share))
    hysteresis = HysteresisFit("Preisach, each actuator its own", own, np.full(21, 1e-9), 2e-9, 0.05, 120, ())
    text = html_page("", [content_hysteresis.hysteresis(replace(calibration, hysteresis=hysteresis))])
    assert "7.1% to 13.6% over the actuators" in text and "the mean over actuators" in text


def test_a_loop_is_that_of_the_signals_seen(calibration: Calibration) -> None:
    """Of a mirror of 0 .. 1, whose law is only known there: 0.4 of a span of 1 + 0.6."""
    hysteresis = HysteresisFit("Preisach", PLAY, np.full(21, 1e-9), 2e-9, 0.05, 120, ())
    seen = replace(calibration, hysteresis=hysteresis, fit=replace(calibration.fit, signal_min=0.0))
    made = content_hysteresis.hysteresis(seen)
    assert "25.0% of the span" in html_page("", [made])
    assert figures_of(seen)["hysteresis"]["loop_opening"] == pytest.approx(0.25)
    for axes in made.pictures[0].figure.axes:
        drawn = np.concatenate([line.get_xdata() for line in axes.lines])
        assert (drawn.min(), drawn.max()) == pytest.approx((0.0, 1.0))


def test_creep_grows_by_its_rate_in_a_decade() -> None:
    # The sum over elements two to a decade follows the straight line within its ripple.
    growth = np.diff(step_response(PLAY, np.array([1.0, 10.0, 100.0, 1000.0])))
    np.testing.assert_allclose(growth, PLAY.creep_rate, rtol=0.1)


def test_a_length_is_put_by_the_wavelength_where_that_says_more() -> None:
    assert content.length(2e-6, 632.8e-9) == "2000.00 nm"
    assert content.length(1.3e-9, 632.8e-9) == "1.30 nm (λ/487)"
