"""Parameters of the instrument: how maps differ from the surface."""

from dm_common.ros.parameters import Parameter, real, switch, whole
from dm_simulation.interferometer.interferometer import InterferometerConfig

_INSTRUMENT = InterferometerConfig()

INTERFEROMETER = (
    Parameter("interferometer.pixels", whole(_INSTRUMENT.pixels, 32, 4096, "px"), "Pixels along each side."),
    Parameter(
        "interferometer.field_diameter",
        real(_INSTRUMENT.field_diameter, 1e-3, 1.0, "m"),
        "Diameter of the field of view.",
    ),
    Parameter("interferometer.wavelength", real(_INSTRUMENT.wavelength, 1e-7, 2e-5, "m"), "Wavelength."),
    Parameter("interferometer.figure_rms", real(_INSTRUMENT.figure_rms, 0.0, 1e-5, "m"), "Initial figure, rms."),
    Parameter("interferometer.pixel_noise", real(_INSTRUMENT.pixel_noise, 0.0, 1e-6, "m"), "Noise per pixel, rms."),
    Parameter(
        "interferometer.low_order_noise",
        real(_INSTRUMENT.low_order_noise, 0.0, 1e-6, "m"),
        "Noise of all Zernike terms of orders 2-5 together, rms over the field.",
    ),
    Parameter("interferometer.piston_spread", real(_INSTRUMENT.piston_spread, 0.0, 1e-4, "m"), "Spread of piston."),
    Parameter(
        "interferometer.tilt_spread", real(_INSTRUMENT.tilt_spread, 0.0, 1e-4, "m"), "Spread of edge sag by tilt."
    ),
    Parameter(
        "interferometer.instrument_error",
        real(_INSTRUMENT.instrument_error, 0.0, 1e-5, "m"),
        "What the instrument adds to every map, rms; a map of it alone lies in output_folder/reference/flat.datx.",
    ),
    Parameter(
        "interferometer.retrace",
        real(_INSTRUMENT.retrace, 0.0, 0.1),
        "What it adds for each m of edge sag by tilt, rms m.",
    ),
    Parameter(
        "interferometer.distortion",
        real(_INSTRUMENT.distortion, -0.05, 0.05),
        "Radial distortion: what lies at the edge is seen further from the centre by this share.",
    ),
    Parameter(
        "interferometer.vibration",
        real(_INSTRUMENT.vibration, 0.0, 1e-7, "m"),
        "Ripples at twice the frequency of the fringes, whose size differs from map to map: median amplitude.",
    ),
    Parameter(
        "interferometer.phase_steps",
        real(_INSTRUMENT.phase_steps, 0.0, 20.0),
        "Mean number of discs per map that stand a whole fringe off.",
    ),
    Parameter(
        "interferometer.mask_diameter",
        real(_INSTRUMENT.mask_diameter, 0.0, 1.0, "m"),
        "Of a mask on the mirror, beyond which nothing is seen; 0 = no mask.",
    ),
    Parameter("interferometer.specks", whole(_INSTRUMENT.specks, 0, 1_000_000), "Mean number of dropped pixels."),
    Parameter("interferometer.blobs", whole(_INSTRUMENT.blobs, 0, 1000), "Dropped discs per map."),
    Parameter(
        "interferometer.mount_angle",
        real(_INSTRUMENT.mount_angle, -7.0, 7.0, "rad"),
        "How the mirror is mounted in the field of view: turned anticlockwise by this, after ...",
    ),
    Parameter("interferometer.mount_mirrored", switch(_INSTRUMENT.mount_mirrored), "... it was mirrored left-right."),
    Parameter("interferometer.mount_x", real(_INSTRUMENT.mount_x, -0.1, 0.1, "m"), "Its centre in the field, x."),
    Parameter("interferometer.mount_y", real(_INSTRUMENT.mount_y, -0.1, 0.1, "m"), "Its centre in the field, y."),
    Parameter(
        "interferometer.mount_scale",
        real(_INSTRUMENT.mount_scale, 0.5, 2.0),
        "Lengths as the instrument sees them / true ones: error of its lateral scale.",
    ),
    Parameter("interferometer.flip_x", switch(_INSTRUMENT.flip_x), "Picture mirrored left-right, after turning."),
    Parameter("interferometer.flip_y", switch(_INSTRUMENT.flip_y), "Picture mirrored upside down, after turning."),
    Parameter(
        "interferometer.rotate_deg",
        whole(_INSTRUMENT.rotate_deg, 0, 270, "deg"),
        "Picture turned anticlockwise by 0, 90, 180 or 270.",
    ),
)
