"""The paper page: its numbers, its files, and that they agree."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from dm_calibration.hysteresis.candidate_fit import COMMON
from dm_calibration.report.document import Section, Table
from dm_calibration.report.pdf_pages import pdf_pages
from studies.comparison.simulated_bench import SimulationConfig
from studies.paper import control, reported, samples
from studies.paper.f_statistic import adjusted_r2_of_f, p_of_f
from studies.paper.page.content_control import vertex_shift_left
from studies.paper.page.page import write_html
from studies.paper.results import PaperOptions
from studies.paper.samples import LEVELLED, PIXELS, POINTS, Samples, measure_samples
from studies.verbs.paper import paper

pytestmark = pytest.mark.slow

SEED = 31
TRIED_LAWS = ("linear", "Prandtl-Ishlinskii")


def run(*arguments: str) -> Any:
    app = Typer()
    app.command()(paper)
    return CliRunner().invoke(app, list(arguments))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder and the figures of a quick run."""
    folder = tmp_path_factory.mktemp("paper")
    with pytest.MonkeyPatch.context() as patch:
        # The law of the simulation and none: the choice among all takes a third of the time and is tested elsewhere.
        patch.setattr(samples, "COMMON", [law for law in COMMON if law.name in TRIED_LAWS])
        result = run("--quick", "--seed", str(SEED), "--out", str(folder), "--json", str(folder / "figures.json"))
    assert result.exit_code == 0, result.output
    return folder, json.loads((folder / "figures.json").read_text())


@pytest.fixture(scope="module")
def ideal() -> Samples:
    return measure_samples(SimulationConfig(law="none", hysteresis=0.0, creep=0.0, seed=SEED, pixels=118))


def test_tables_2_and_3_have_every_model_and_surface(made: tuple[Path, dict[str, Any]]) -> None:
    figures = made[1]
    for model in reported.MODELS:
        row = figures["table2"][model]
        assert row["n"] == 50 and row["k"] >= 1
        # F, n and k determine the other two: the figures belong to one model. WLS and OLS alike.
        assert row["adj_r2"] == pytest.approx(adjusted_r2_of_f(row["f"], row["n"], row["k"]), abs=1e-9)
        assert row["p"] == pytest.approx(p_of_f(row["f"], row["n"], row["k"]), rel=1e-6)
        assert row["held_out_rms_nm"] > 0.0
    assert set(figures["table3"]) == set(reported.TEST_SURFACES)
    for surface, models in figures["table3"].items():
        for model, row in models.items():
            assert row["err_nm"] == pytest.approx(row["predicted_nm"] - row["actual_nm"]), (surface, model)
            assert row["rel_err_pct"] == pytest.approx(100.0 * abs(row["err_nm"]) / row["actual_nm"])
            assert row["lower_nm"] <= row["predicted_nm"] <= row["upper_nm"]


def test_predicting_from_the_history_beats_the_plain_linear_reading(made: tuple[Path, dict[str, Any]]) -> None:
    readings = made[1]["table2_readings"]
    for model in reported.MODELS:
        assert readings["history"][model]["held_out_rms_nm"] < 0.5 * readings["linear"][model]["held_out_rms_nm"]


def test_selection_makes_p_optimistic(made: tuple[Path, dict[str, Any]]) -> None:
    assert made[1]["shuffled_significant"] > 0.25  # an honest 5 % level: 20 shuffles would give 1


def test_regions_and_cancelling_weights(made: tuple[Path, dict[str, Any]]) -> None:
    figures = made[1]
    for regions in (figures["regions"], figures["regions"]["zernike"], figures["ideal"]["regions"]):
        assert regions["area_pct"] == pytest.approx(list(range(10, 101, 10)))
        assert len(regions["mean_nm"]) == len(regions["variance_nm2"]) == 10
        assert min(regions["mean_nm"]) > 0.0 and min(regions["variance_nm2"]) > 0.0
    assert 0.0 <= figures["weights_cancel_max_abs"] < 1e-16  # G is of the order of 1e-7 m per unit signal


def test_linearity_is_lost_to_hysteresis_alone(made: tuple[Path, dict[str, Any]]) -> None:
    folder, figures = made
    for group, line in figures["linearity"].items():
        ideal = figures["ideal"]["linearity"][group]
        assert ideal["departure_pct"] < 1.0 and ideal["r2"] > 0.999
        assert 1.0 < line["departure_pct"] < 10.0 and 0.99 < line["r2"] < 0.999
        row = re.search(rf"<tr><td>{group}</td>(.*?)</tr>", (folder / "index.html").read_text().split("linearity: ")[1])
        assert row and f"{line['rate_nm']:.1f}" in row[1] and f"{line['r2']:.5f}" in row[1]
    # One actuator against the others, and how all differ.
    assert figures["linearity"]["p46–p54"]["rate_nm"] > 5 * figures["linearity"]["p01–p05"]["rate_nm"]


def test_a_shifted_vertex_is_tilt() -> None:
    assert 0.0 < vertex_shift_left(0.011) < 1e-12  # m, where the tilt is 6 µm


def test_hysteresis_costs_what_ideal_actuators_do_not_show(made: tuple[Path, dict[str, Any]]) -> None:
    figures = made[1]
    ideal = figures["ideal"]
    assert figures["branch_spread_nm"] > 20 * ideal["branch_spread_nm"]
    for method, readings in figures["control"].items():
        assert readings["measured"]["p50_nm"] > 3 * ideal["control"][method]["measured"]["p50_nm"]
        assert readings["closed loop"]["p50_nm"] < 0.5 * readings["measured"]["p50_nm"]
        assert 1.0 <= readings["closed loop"]["maps"] <= control.LOOP_MAPS
    assert ideal["control"]["AZreg"]["stored"]["within"]["lambda/50"] == 1.0


def test_maps_and_hysteresis_reach_a_thousandth_of_the_wavelength(made: tuple[Path, dict[str, Any]]) -> None:
    figures = made[1]
    readings = figures["control"]["AZreg"]
    following = readings[control.LOOP_HYSTERESIS]
    assert following["maps"] == control.LOOP_MAPS
    assert following["within"]["lambda/1000"] == 1.0
    assert readings["closed loop"]["within"]["lambda/50"] == 1.0
    assert readings[control.OPEN_HYSTERESIS]["maps"] == 0.0
    assert readings[control.OPEN_HYSTERESIS]["true_p50_nm"] < 0.2 * readings["stored"]["true_p50_nm"]
    # A noisy map cannot show what the noise-free surface does.
    assert following["p50_nm"] > following["true_p50_nm"]
    for order in following["orders"].values():
        shares = list(order["within"].values())
        assert shares == sorted(shares, reverse=True)
        assert order["max_nm"] <= max(following["true_max_zernike_nm"])


def test_sampling_study_is_reported(made: tuple[Path, dict[str, Any]]) -> None:
    ways = made[1]["sampling"]["ways"]
    assert ways["full map"]["bias_rms_nm"] < 1e-6
    assert ways["edge-clustered, area-weighted"]["bias_rms_nm"] < ways["edge-clustered"]["bias_rms_nm"]
    assert ways["full map"]["noise_rms_nm"] < ways["uniform"]["noise_rms_nm"]


def test_regions_on_points_and_on_every_pixel_agree(made: tuple[Path, dict[str, Any]]) -> None:
    readings = made[1]["regions_readings"]
    assert set(readings) == {POINTS, PIXELS, LEVELLED}
    assert readings[POINTS]["mean_nm"] == made[1]["regions"]["mean_nm"]
    # The smallest disc holds few of the 200 points of a quick run.
    assert readings[POINTS]["mean_nm"][1:] == pytest.approx(readings[PIXELS]["mean_nm"][1:], rel=0.05)
    assert np.all(np.array(readings[LEVELLED]["mean_nm"]) < np.array(readings[POINTS]["mean_nm"]) + 1e-9)


def test_only_maps_of_sample_surfaces_are_kept() -> None:
    bench = samples._MapKeepingBench(SimulationConfig(pixels=64, samples=50))
    for label in ("p03", "reference 1"):
        bench.measure(label)
    assert list(bench.kept) == ["p03"]


def test_page_pictures_and_pdf_belong_together(made: tuple[Path, dict[str, Any]]) -> None:
    folder, figures = made
    page = (folder / "index.html").read_text()
    named = re.findall(r'<img src="([^"]+)"', page)
    assert sorted(named) == sorted(figures["files"]["pictures"])
    assert {f"fig{number}.png" for number in range(4, 10)} <= set(named)
    for name in named:
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    assert (folder / "paper.pdf").read_bytes().startswith(b"%PDF")
    for heading in ("Table 1", "Table 2", "Table 3", "Figs. 6 and 7", "Figs. 8 and 9", "Claims"):
        assert re.search(rf"<h2>{heading}", page), heading
    assert not re.search(r"https?://|\bnan\b", page)
    assert "in readings other than “linear” divided by the number of candidates" in page
    # The paper's value and this run's stand in the same row.
    table = page[page.index("<caption>Table 3") :]
    for surface, models in figures["table3"].items():
        row = re.search(rf"<tr><td>{surface}</td>(.*?)</tr>", table)
        assert row
        for model in reported.MODELS:
            assert f"{reported.TABLE_3[surface][model].err_nm:+.3f}" in row[1]
            assert f"{models[model]['err_nm']:+.3f}" in row[1]


def test_the_papers_numbers_agree_with_each_other() -> None:
    for row in reported.TABLE_2.values():
        assert adjusted_r2_of_f(row.f, row.n, row.k) == pytest.approx(row.adj_r2, abs=6e-4)
        assert p_of_f(row.f, row.n, row.k) == pytest.approx(row.p, rel=1e-3)
    for name, models in reported.TABLE_3.items():
        # Err / RelErr is the true error, the same for both models.
        assert abs(models["AZreg"].err_nm) / (models["AZreg"].rel_err_pct / 100) == pytest.approx(
            reported.implied_error_nm(name), rel=0.02
        )


def test_initial_states_and_targets(ideal: Samples) -> None:
    for target, name in ((control.FocusTarget(0.03), "p55"), (control.FocusTarget(-0.03), "p56")):
        assert control.initial_state(target) == name
        # p55 and p56 are on the target's side of flat, so the move is the shorter one.
        defocus = ideal.calibration.maps.coefficients[ideal.row(name), 3]
        wanted = target.coefficients(ideal.bench.mirror.working_radius)[3]
        assert abs(wanted - defocus) < abs(wanted)
    curvatures = [target.curvature for target in control.spheres(11)]
    assert curvatures == pytest.approx(np.linspace(-0.05, 0.05, 11))


def test_every_method_starts_from_the_same_mirror(ideal: Samples) -> None:
    before = ideal.bench.time
    first, second = (control.run_series(ideal, "AZreg", "stored", control.spheres(3)) for _ in range(2))
    assert ideal.bench.time == before
    np.testing.assert_array_equal(first.max_zernike, second.max_zernike)


def test_unknown_reading_is_refused(ideal: Samples) -> None:
    with pytest.raises(ValueError, match="must be one of stored, measured, closed loop"):
        control.run_series(ideal, "AZreg", "by eye", control.spheres(3))


@pytest.mark.parametrize("field", ["spheres", "seeds", "shuffles"])
def test_options_out_of_range_are_refused(field: str) -> None:
    changed: dict[str, Any] = {field: 0}
    with pytest.raises(ValueError, match=f"{field} = 0: must be at least"):
        PaperOptions(SimulationConfig(), **changed)


def test_a_file_as_folder_is_refused_before_anything_runs(tmp_path: Path) -> None:
    file = tmp_path / "page"
    file.write_text("")
    result = run("--quick", "--out", str(file))
    assert result.exit_code != 0
    assert "name a folder" in str(result.exception)


def test_text_is_escaped_and_long_tables_go_on_over_pages(tmp_path: Path) -> None:
    table = Table("many", ("a", "b"), [(f"row {k}", "<&>") for k in range(150)])
    section = Section("a < b & c", ["x < y"], [table])
    page = write_html(tmp_path, "t & u", [section]).read_text()
    assert "a &lt; b &amp; c" in page and page.count("&lt;&amp;&gt;") == 150
    pdf = pdf_pages("t", [section])
    assert len(re.findall(rb"/Type /Page\b", pdf)) >= 3
