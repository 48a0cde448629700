"""The report: all sections in order, as one HTML file and one PDF file."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dm_calibration.calibration import Calibration
from dm_calibration.calibration_parameters import CRITERIA
from dm_calibration.influence.quality import GRADE_NAMES
from dm_calibration.recalibration.check_log import SUFFIX, read_checks
from dm_calibration.recalibration.drift import UpdateOptions
from dm_calibration.recalibration.updates import RecalibrationManager
from dm_calibration.report import certificate, checks, content, content_fit, content_hysteresis
from dm_calibration.report.content_hysteresis import loop_opening
from dm_calibration.report.document import Section
from dm_calibration.report.html_page import html_page
from dm_calibration.report.pdf_pages import pdf_pages
from dm_common.atomic_write import write_whole


def sections(calibration: Calibration, file: Path, values: Mapping[str, Any] = CRITERIA) -> list[Section]:
    """All sections of the report of `calibration`, read from `file`; `values` of the parameters named in CRITERIA.

    Raises:
        OSError: `file` cannot be read.
    """
    left = content_fit.residuals(calibration)
    updates = RecalibrationManager(file.parent, lambda: UpdateOptions(surprises_max=values["updates.surprises_max"]))
    updates.begin(calibration)
    log = read_checks(file.with_name(f"{calibration.id}{SUFFIX}"))
    return [
        certificate.certificate(calibration, certificate.people(), log, values, updates.doubts),
        certificate.every_actuator(calibration),
        Section("Appendix", ["What the two pages before rest on."]),
        *([checks.checks_section(calibration, log, values)] if log else []),
        content.summary(calibration),
        content.provenance(calibration),
        content.cautions(calibration),
        content_fit.residual(calibration),
        content_fit.regions(calibration, left),
        content_fit.coefficients(calibration, left),
        content_fit.influence(calibration),
        content_hysteresis.hysteresis(calibration),
        content_hysteresis.recipes(calibration),
        content.every_map(calibration),
        content.files(calibration, file.name, hashlib.sha256(file.read_bytes()).hexdigest()),
    ]


def write_report(
    calibration: Calibration, folder: Path, file: Path, values: Mapping[str, Any] = CRITERIA
) -> tuple[Path, Path]:
    """Write ``<id>.html`` and ``<id>.pdf`` into `folder`, each atomically; returns the two files. Args as `sections`.

    Raises:
        OSError: `file` cannot be read, or `folder` cannot be written to.
    """
    made = sections(calibration, file, values)
    title = f"Calibration {calibration.id} of {calibration.mirror_name}, serial {calibration.mirror_serial}"
    page, pdf = folder / f"{calibration.id}.html", folder / f"{calibration.id}.pdf"
    write_whole(page, html_page(title, made).encode())
    write_whole(pdf, pdf_pages(title, made))
    return page, pdf


def figures_of(calibration: Calibration) -> dict[str, Any]:
    """The key figures as a dictionary, for use by programs."""
    fit, hysteresis = calibration.fit, calibration.hysteresis
    names, counts = np.unique([GRADE_NAMES[grade] for grade in fit.grades], return_counts=True)
    result: dict[str, Any] = {
        "id": calibration.id,
        "mirror": calibration.mirror_name,
        "serial": calibration.mirror_serial,
        "created_ns": calibration.created_ns,
        "wavelength_m": calibration.wavelength,
        "aperture_radius_m": calibration.aperture_radius,
        "method": fit.method,
        "maps_used": int(fit.used.sum()),
        "maps_dropped": calibration.maps_dropped,
        "in_sample_rms_nm": fit.in_sample_rms * 1e9,
        "held_out_rms_nm": fit.held_out_rms * 1e9,
        "held_out_max_zernike_nm": fit.held_out_max_zernike * 1e9,
        "remeasured_max_zernike_nm": max((r.max_zernike for r in calibration.recipes.recipes), default=np.nan) * 1e9,
        "condition_number": fit.condition_number,
        "grades": dict(zip(names.tolist(), counts.tolist(), strict=True)),
        "limitations": list(calibration.limitations),
        "hysteresis": None,
    }
    if hysteresis is not None:
        result["hysteresis"] = {
            "law": hysteresis.name,
            "held_out_max_zernike_nm": hysteresis.held_out_max_zernike * 1e9,
            "loop_opening": float(loop_opening(hysteresis.law, fit.signal_min, fit.signal_max).mean()),
            "creep_per_decade": hysteresis.law.creep_rate,
        }
    return result
