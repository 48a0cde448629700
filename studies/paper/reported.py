"""Values that the paper itself reports, with their place in it.

Source: [1]. Lengths in nm, as printed.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

#: Wavelength, section 2.1, m.
WAVELENGTH = 632.8e-9
#: Section 3.1: the eight surfaces that were kept out of the regression.
TEST_SURFACES = ("p04", "p09", "p16", "p34", "p44", "p47", "p51", "p55")
#: The two models, in the order of Tables 2 and 3.
MODELS = ("AZWreg", "AZreg")


class Significance(NamedTuple):
    """A column of Table 2; n and k are not printed there: they are the only small integers that fit its figures."""

    adj_r2: float
    f: float
    p: float
    n: int
    k: int


class Prediction(NamedTuple):
    """A pair of columns of Table 3."""

    err_nm: float
    rel_err_pct: float


#: Table 2.
TABLE_2 = MappingProxyType(
    {
        "AZWreg": Significance(0.764, 10.123, 2.477e-8, 49, 17),
        "AZreg": Significance(0.201, 3.055, 1.404e-2, 50, 6),
    }
)

#: Table 3.
TABLE_3 = MappingProxyType(
    {
        "p04": {"AZWreg": Prediction(0.539, 0.93), "AZreg": Prediction(-8.757, 15.07)},
        "p09": {"AZWreg": Prediction(-9.050, 16.15), "AZreg": Prediction(-5.496, 9.81)},
        "p16": {"AZWreg": Prediction(0.473, 0.88), "AZreg": Prediction(-4.528, 8.37)},
        "p34": {"AZWreg": Prediction(-3.669, 6.69), "AZreg": Prediction(-1.853, 3.38)},
        "p44": {"AZWreg": Prediction(-0.570, 1.13), "AZreg": Prediction(-0.604, 1.20)},
        "p47": {"AZWreg": Prediction(1.876, 4.23), "AZreg": Prediction(4.729, 10.65)},
        "p51": {"AZWreg": Prediction(-1.287, 2.96), "AZreg": Prediction(5.616, 12.90)},
        "p55": {"AZWreg": Prediction(3.055, 6.87), "AZreg": Prediction(-20.065, 45.09)},
    }
)

#: Section 2.2, on Fig. 5(a): variance over p01-p58 inside the discs of 10 % and 100 % of the area, nm^2.
FIG_5A_VARIANCE_NM2 = MappingProxyType({10: 12.34, 100: 25.68})
#: Section 2.2, on Fig. 5(b): range of the variances over nine Zernike surfaces, nm^2.
FIG_5B_VARIANCE_NM2 = (1.00, 1.33)
#: Section 3.2: the residual Zernike coefficients are said to fall from λ/50 to λ/1000; parts of the wavelength.
CLAIM_PARTS = (50, 1000)
#: Section 3.2: curvatures of the spheres, 1/m.
CURVATURE_RANGE = (-0.05, 0.05)
#: Section 3.1: RelErr of AZWreg "was generally less than 7 %".
REL_ERR_PCT = 7.0

#: Table 1: surfaces and the description printed there.
TABLE_1 = (
    ("p01–p05", "all channels at −1, −0.5, 0, +0.5, +1"),
    ("p06–p42", "channels 1, 2, …, 37 in turn at +1, all others at −1"),
    ("p43", "circle 2 (channels 2–7) at +1, all others at −1"),
    ("p44", "circle 3 (channels 8–19) at +1, all others at −1"),
    ("p45", "circle 4 (channels 20–37) at +1, all others at −1"),
    ("p46–p54", "channel 1 at −0.8, −0.6, …, +0.8, all others at −1"),
    ("p55, p56", "spheres with a radius of curvature of ±60 m"),
    ("p57, p58", "spheres with a radius of curvature of ±100 m"),
    ("pz01–pz11", "Zernike terms Z₁¹, Z₂⁰, Z₂², Z₃¹, Z₃³, Z₄⁰, Z₄², Z₄⁴, Z₅¹, Z₅³, Z₅⁵"),
)


def implied_error_nm(surface: str) -> float:
    """True surface control error of a test surface that Table 3 implies, Err / RelErr, nm."""
    pair = TABLE_3[surface]["AZWreg"]
    return abs(pair.err_nm) / (pair.rel_err_pct / 100.0)
