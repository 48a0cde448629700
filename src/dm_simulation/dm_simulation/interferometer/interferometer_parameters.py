"""Parameters of the instrument: how maps differ from the surface."""

from dm_common.ros.parameters import fields_of, real, switch, whole
from dm_simulation.interferometer.interferometer import InterferometerConfig

_instrument = fields_of("interferometer", InterferometerConfig())

INTERFEROMETER = (
    _instrument("pixels", whole(..., 32, 4096, "px"), "Pixels along each side."),
    _instrument("field_diameter", real(..., 1e-3, 1.0, "m"), "Diameter of the field of view."),
    _instrument("wavelength", real(..., 1e-7, 2e-5, "m"), "Wavelength."),
    _instrument("figure_rms", real(..., 0.0, 1e-5, "m"), "Initial figure, rms."),
    _instrument("pixel_noise", real(..., 0.0, 1e-6, "m"), "Noise per pixel, rms."),
    _instrument(
        "low_order_noise",
        real(..., 0.0, 1e-6, "m"),
        "Noise of all Zernike terms of orders 2-5 together, rms over the field.",
    ),
    _instrument("piston_spread", real(..., 0.0, 1e-4, "m"), "Spread of piston."),
    _instrument("tilt_spread", real(..., 0.0, 1e-4, "m"), "Spread of edge sag by tilt."),
    _instrument(
        "instrument_error",
        real(..., 0.0, 1e-5, "m"),
        "What the instrument adds to every map, rms; a map of it alone lies in output_folder/reference/flat.datx.",
    ),
    _instrument("retrace", real(..., 0.0, 0.1), "What it adds for each m of edge sag by tilt, rms m."),
    _instrument(
        "distortion",
        real(..., -0.05, 0.05),
        "Radial distortion: what lies at the edge is seen further from the centre by this share.",
    ),
    _instrument(
        "vibration",
        real(..., 0.0, 1e-7, "m"),
        "Ripples at twice the frequency of the fringes, whose size differs from map to map: median amplitude.",
    ),
    _instrument("phase_steps", real(..., 0.0, 20.0), "Mean number of discs per map that stand a whole fringe off."),
    _instrument(
        "mask_diameter", real(..., 0.0, 1.0, "m"), "Of a mask on the mirror, beyond which nothing is seen; 0 = no mask."
    ),
    _instrument("specks", whole(..., 0, 1_000_000), "Mean number of dropped pixels."),
    _instrument("blobs", whole(..., 0, 1000), "Dropped discs per map."),
    _instrument(
        "mount_angle",
        real(..., -7.0, 7.0, "rad"),
        "How the mirror is mounted in the field of view: turned anticlockwise by this, after ...",
    ),
    _instrument("mount_mirrored", switch(...), "... it was mirrored left-right."),
    _instrument("mount_x", real(..., -0.1, 0.1, "m"), "Its centre in the field, x."),
    _instrument("mount_y", real(..., -0.1, 0.1, "m"), "Its centre in the field, y."),
    _instrument(
        "mount_scale",
        real(..., 0.5, 2.0),
        "Lengths as the instrument sees them / true ones: error of its lateral scale.",
    ),
    _instrument("flip_x", switch(...), "Picture mirrored left-right, after turning."),
    _instrument("flip_y", switch(...), "Picture mirrored upside down, after turning."),
    _instrument("rotate_deg", whole(..., 0, 270, "deg"), "Picture turned anticlockwise by 0, 90, 180 or 270."),
)
