"""A calibration: its maps, the influence function fitted to them, and its provenance."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from typing import Any, get_origin, get_type_hints

import numpy as np

from dm_calibration.hysteresis.hysteresis_fit import HysteresisFit
from dm_calibration.influence.fit import InfluenceFit
from dm_calibration.influence.maps import MapSet
from dm_calibration.influence.quality import GRADE_NAMES, NO_RESPONSE
from dm_calibration.store.hdf5_image import Attribute, Column
from dm_calibration.store.hysteresis_storage import hysteresis_columns, hysteresis_from, recipe_columns, recipes_from
from dm_common import Floats
from dm_common.errors import CodedError, ErrorCode
from dm_common.figures import in_nanometres
from dm_common.hysteresis.model import request_error
from dm_common.mirror import actuators_text
from dm_common.optics.sample_regions import AREA_FRACTIONS
from dm_common.optics.sampling import SamplePoints
from dm_common.recipes import NO_RECIPES, RecipeBook
from dm_common.values import check_array

SCHEMA = "dm_calibration/calibration"
SCHEMA_VERSION = 1
#: Default of `calibrated_error_max`, m: with a larger promise a mirror counts as approximate; about wavelength/20.
CALIBRATED_ERROR_MAX = 32e-9
#: Prefix of limitations that are findings of the poke check.
POKE_CHECK = "Poke check: "

_POINTS = ("x", "y", "weight")
#: Fields whose attribute in the file has another name.
_STORED_AS = {"limitations": "known_limitations"}


class CalibrationFileError(CodedError, ValueError):
    """A calibration file is damaged, foreign, or of an unknown schema; the message says which and where."""

    error_code = ErrorCode.CALIBRATION_UNREADABLE


@dataclass(frozen=True)
class Calibration:
    """A complete calibration: raw data, result and provenance, all of it stored in one file.

    Attributes:
        id: unique name, also the file's stem.
        wavelength: m; 0 = not given by the maps.
        aperture_radius: m.
        created_ns: time of writing, ns since the epoch of the node's clock.
        actuator_x, actuator_y: (N,) m, positions as configured at the time of the measurement.
        dropped: "label: reason" for each state without a map.
        targets: "label: aim" of each shape solved with an influence function; the coefficients are in maps.nominal.
        limitations: sentences from the fit, the run and the poke check.
        hysteresis: hysteresis and creep model; if given, `fit` acts on effective signals. None = not identified.
        system_error_subtracted: whether the instrument itself subtracted its error: 1 yes, 0 no, -1 not known.
        reference_surface: instrument errors subtracted from every map, as text: map with its SHA-256, retrace error,
            distortion; "" = none.
        instrument_error: 95 % bound on the instrument error remaining in a coefficient, m; 0 = not known.
        scale_error: 95 % bound on the relative error of lengths on the mirror; 0 = not known.
        region_weights: (10,) Eq. (8), for commands weighted by region; empty if no sample surfaces were measured.
    """

    id: str
    mirror_name: str
    mirror_serial: str
    wavelength: float
    aperture_radius: float
    created_ns: int
    actuator_x: Floats
    actuator_y: Floats
    maps: MapSet
    fit: InfluenceFit
    dropped: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    limitations: tuple[str, ...] = ()
    note: str = ""
    software_version: str = ""
    hysteresis: HysteresisFit | None = None
    recipes: RecipeBook = NO_RECIPES
    system_error_subtracted: int = -1
    reference_surface: str = ""
    instrument_error: float = 0.0
    scale_error: float = 0.0
    region_weights: Floats = field(default_factory=lambda: np.zeros(0))

    def __repr__(self) -> str:
        """What it is of and how good, not the arrays."""
        law = f"law of the actuators: {self.hysteresis.name}, " if self.hysteresis else ""
        return f"<Calibration {self.id}: {self.maps.has_map.sum()} maps, {law}promise {in_nanometres(self.promise)}>"

    @property
    def stamp_ns(self) -> int:
        """Time of the last map, ns."""
        return int(self.maps.stamp_ns.max())

    @property
    def promise(self) -> float:
        """95 % bound on the largest coefficient error of a request, m, from maps that were not used in the fit."""
        return request_error(self.fit, self.hysteresis)

    def doubts(self, error_max: float = CALIBRATED_ERROR_MAX) -> list[str]:
        """Reasons why the calibration counts as approximate only; empty = the mirror is calibrated.

        Args:
            error_max: largest promise that counts as calibrated, m.
        """
        silent = ((np.flatnonzero(self.fit.grades == grade) + 1, GRADE_NAMES[grade]) for grade in NO_RESPONSE)
        reasons = [actuators_text(numbers, f"is/are {name}") for numbers, name in silent if numbers.size]
        if not self.promise <= error_max:  # NaN too
            reasons.append(f"the promise is above {in_nanometres(error_max)} (calibrated_error_max)")
        return reasons

    @property
    def maps_dropped(self) -> int:
        """Number of maps that were excluded from the fit, plus states of which no map could be taken."""
        return len(self.maps.rejected(self.fit.reasons)) + len(self.dropped)


#: Fields of a calibration that are stored as attributes of its file, with their types.
_ATTRIBUTES: dict[str, type] = {
    name: kind
    for name, hint in get_type_hints(Calibration).items()
    if (kind := get_origin(hint) or hint) in (str, int, float, tuple)
}


def software_version() -> str:
    """Version of this package as installed; "unknown" when run from a bare checkout."""
    try:
        return version("dm_calibration")
    except PackageNotFoundError:
        return "unknown"


def to_columns(calibration: Calibration) -> tuple[dict[str, Column], dict[str, Attribute]]:
    """The calibration as datasets and root attributes of its file."""
    maps, fit = calibration.maps, calibration.fit
    columns: dict[str, Column] = {
        "mirror/actuator_x": np.asarray(calibration.actuator_x, dtype=np.float64),
        "mirror/actuator_y": np.asarray(calibration.actuator_y, dtype=np.float64),
    }
    columns |= {f"points/{name}": getattr(maps.points, name) for name in _POINTS}
    columns |= {f"maps/{name}": getattr(maps, name) for name in MapSet.columns()}
    columns["maps/reference"] = maps.reference
    attributes: dict[str, Attribute] = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        **{_STORED_AS.get(name, name): kind(getattr(calibration, name)) for name, kind in _ATTRIBUTES.items()},
        "maps_used": int(fit.used.sum()),
    }
    for figure in fields(InfluenceFit):
        value = getattr(fit, figure.name)
        if isinstance(value, np.ndarray) or figure.name == "reasons":
            columns[f"result/{figure.name}"] = value
        elif figure.name != "points":
            attributes[f"fit_{figure.name}"] = value
    if calibration.region_weights.size:
        columns["regions/weights"] = calibration.region_weights
    columns |= hysteresis_columns(calibration.hysteresis) | recipe_columns(calibration.recipes)
    return columns, attributes


def from_columns(columns: Mapping[str, Column], attributes: Mapping[str, Attribute]) -> Calibration:
    """The calibration in the datasets and attributes of a file.

    Raises:
        CalibrationFileError: another schema, or something is missing, of a wrong type or shape, or not finite.
    """
    if attributes.get("schema") != SCHEMA:
        raise CalibrationFileError(f"schema {attributes.get('schema')!r}: not a calibration of this suite")
    if attributes.get("schema_version") != SCHEMA_VERSION:
        raise CalibrationFileError(
            f"schema version {attributes.get('schema_version')}: this software reads {SCHEMA_VERSION}"
        )
    try:
        points = SamplePoints(*(np.asarray(columns[f"points/{name}"], dtype=np.float64) for name in _POINTS))
        # Older files lack the time of the last move, the segment of the run and the temperature: not known.
        unknown = np.zeros(len(columns["maps/stamp_ns"]), dtype=np.int64)
        before = {"maps/moved_ns": unknown, "maps/segment": unknown, "maps/temperature": np.full(len(unknown), np.nan)}
        columns = before | dict(columns)
        raw: dict[str, Any] = {name: columns[f"maps/{name}"] for name in MapSet.columns()}
        maps = MapSet(points=points, **raw)
        # Older files hold nothing on the instrument's own error: not known.
        defaults: dict[str, Attribute] = {"system_error_subtracted": -1, "reference_surface": ""}
        attributes = defaults | {"instrument_error": 0.0, "scale_error": 0.0} | dict(attributes)
        figures = [figure.name for figure in fields(InfluenceFit) if figure.name != "points"]
        result: dict[str, Any] = {
            name: columns[path] if (path := f"result/{name}") in columns else attributes[f"fit_{name}"]
            for name in figures
        }
        fit = InfluenceFit(points=points, **result)
        described: dict[str, Any] = {
            name: _typed(attributes, _STORED_AS.get(name, name), kind) for name, kind in _ATTRIBUTES.items()
        }
        calibration = Calibration(
            **described,
            actuator_x=np.asarray(columns["mirror/actuator_x"], dtype=np.float64),
            actuator_y=np.asarray(columns["mirror/actuator_y"], dtype=np.float64),
            maps=maps,
            fit=fit,
            hysteresis=hysteresis_from(columns),
            recipes=recipes_from(columns),
            region_weights=np.asarray(columns.get("regions/weights", np.zeros(0)), dtype=np.float64),
        )
        _check_result(calibration)
    except KeyError as error:
        raise CalibrationFileError(f"{error.args[0]} is missing") from error
    except (TypeError, ValueError) as error:
        raise CalibrationFileError(str(error)) from error
    return calibration


def _typed(attributes: Mapping[str, Attribute], name: str, kind: type) -> Attribute:
    value = attributes[name]
    if not isinstance(value, kind):
        raise ValueError(f"attribute {name} = {value!r}: must be a {kind.__name__}")
    return value


def _check_result(calibration: Calibration) -> None:
    """Check shapes and finiteness of all values that a controller uses. Raises ValueError."""
    fit, maps = calibration.fit, calibration.maps
    n, k, p, m = maps.actuators, maps.terms, maps.points.x.size, len(maps)
    shapes = {
        "influence_zernike": (k, n),
        "zernike_offset": (k,),
        "influence_sag": (p, n),
        "sag_offset": (p,),
        "response": (n,),
        "standard_error": (n,),
        "signal_covariance": (n, n),
        "grades": (n,),
        "used": (m,),
        "map_residual": (m,),
    }
    for name, shape in shapes.items():
        check_array(f"result/{name}", getattr(fit, name), shape, finite=name != "map_residual")
    if not np.isin(fit.grades, range(len(GRADE_NAMES))).all():
        raise ValueError(f"result/grades: must be 0 to {len(GRADE_NAMES) - 1}")
    if len(fit.reasons) != m:
        raise ValueError(f"result/reasons has {len(fit.reasons)} entries: must be {m}")
    for name in ("actuator_x", "actuator_y"):
        check_array(f"mirror/{name}", getattr(calibration, name), (n,))
    for name in _POINTS:
        check_array(f"points/{name}", getattr(maps.points, name), (p,))
    if calibration.hysteresis is not None:
        check_array("memory/zernike_sigma", calibration.hysteresis.zernike_sigma, (k,))
    for recipe in calibration.recipes.recipes:
        check_array("recipes/effective", recipe.effective, (n,))
    weights = calibration.region_weights
    if weights.size and not (
        weights.shape == (len(AREA_FRACTIONS),) and np.all(weights > 0.0) and np.all(weights <= 1.0)
    ):
        raise ValueError(f"regions/weights: must be {len(AREA_FRACTIONS)} numbers above 0, at most 1")
    if not calibration.aperture_radius > 0.0:
        raise ValueError(f"aperture_radius = {calibration.aperture_radius}: must be positive, m")
