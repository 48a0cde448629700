"""Images of a camera: their grey levels as arrays, and which of them show the requested focus."""

import io
import math
import sys
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image


@dataclass(frozen=True)
class _Layout:
    """Memory layout of the pixels of an encoding.

    Attributes:
        type: NumPy type of the numbers.
        channels: numbers per pixel.
        channel: index of the number that is used.
        green: for a Bayer pattern, the columns of the green pixels in the even and in the odd rows.
    """

    type: str
    channels: int = 1
    channel: int = 0
    green: tuple[int, int] | None = None


#: Planar encodings: first the luminance of all pixels, then the colours, which are not used.
PLANAR = ("nv21", "nv24")
#: Of colours the green one is used: it has most of the luminance, and in a Bayer sensor half of the pixels. Of YUV the
#: luminance is used.
ENCODINGS: dict[str, _Layout] = {
    "mono8": _Layout("u1"),
    "8UC1": _Layout("u1"),
    "mono16": _Layout("u2"),
    "16UC1": _Layout("u2"),
    "32FC1": _Layout("f4"),
    "8UC3": _Layout("u1", 3, 1),
    **{
        f"{order}{bits}": _Layout(kind, len(order), 1)
        for order in ("rgb", "bgr", "rgba", "bgra")
        for bits, kind in ((8, "u1"), (16, "u2"))
    },
    **{
        f"bayer_{pattern}{bits}": _Layout(kind, green=green)
        for pattern, green in (("rggb", (1, 0)), ("bggr", (1, 0)), ("gbrg", (0, 1)), ("grbg", (0, 1)))
        for bits, kind in ((8, "u1"), (16, "u2"))
    },
    **{name: _Layout("u1", 2, 1) for name in ("uyvy", "yuv422")},
    **{name: _Layout("u1", 2, 0) for name in ("yuyv", "yuv422_yuy2")},
    **{name: _Layout("u1") for name in PLANAR},
}
#: Share of pixels with the largest value from which on the exposure counts as faulty.
CLIPPED = 0.2
#: Smallest share of brighter pixels with which an image of grey levels 0 and 1 is not almost black.
HOT_PIXELS = 1e-3
#: Longest time by which an exposure may seem to begin after its image has arrived [s], as clocks agree only roughly;
#: and with a simulated clock, which only ticks now and then.
STAMP_AHEAD, STAMP_AHEAD_SIMULATED = 0.05, 0.5


#: Encodings by the modes to which Pillow decodes images, "I" for 16 bits before its version 10.3; images of other modes
#: are converted to RGB.
MODES = {"L": "mono8", "I;16": "mono16", "I;16B": "mono16", "I": "mono16", "F": "32FC1", "RGB": "rgb8", "RGBA": "rgba8"}
#: Formats that compressed_image_transport sends. Pillow knows many more, and starts Ghostscript for one of them.
FORMATS = ("JPEG", "PNG", "TIFF")


def decompressed(data: bytes, image_format: str) -> tuple[NDArray, str]:
    """Pixels (height, width, ...) and encoding of the JPEG, PNG or TIFF of a `sensor_msgs/CompressedImage`.

    Args:
        data: the file.
        image_format: as in the message; of "bayer_rggb8; jpeg compressed", the first part is used.

    Raises:
        ValueError: it is no image of these formats, or damaged.
    """
    import PIL.Image  # imported here: needed for compressed images only

    try:
        with PIL.Image.open(io.BytesIO(data), formats=FORMATS) as image:
            decoded = image if image.mode in MODES else image.convert("RGB")
            encoding = MODES[decoded.mode]
            pixels = np.asarray(decoded).astype(ENCODINGS[encoding].type, copy=False)
    except PIL.UnidentifiedImageError as error:  # its text has an address in memory
        raise ValueError(f"an image of the format {image_format!r} that is not JPEG, PNG or TIFF") from error
    except (OSError, ValueError, SyntaxError, PIL.Image.DecompressionBombError) as error:
        raise ValueError(f"an image of the format {image_format!r} that cannot be decoded: {error}") from error
    mosaic = image_format.partition(";")[0].strip()
    layout = ENCODINGS.get(mosaic)
    if layout is not None and layout.green is not None and pixels.ndim == 2 and pixels.dtype == np.dtype(layout.type):
        encoding = mosaic  # the compressed image is the Bayer pattern of the sensor
    return pixels, encoding


def raw_image(message: Image | CompressedImage) -> Image:
    """The image itself, or what is in a compressed one. Raises ValueError when it cannot be decoded."""
    if isinstance(message, Image):
        return message
    return image_message(message.header, *decompressed(bytes(message.data), message.format))


def image_message(header: Any, pixels: NDArray, encoding: str, big_endian: bool = sys.byteorder == "big") -> Image:
    """Pixels (H, W, ...) as an image."""
    image = Image(header=header, height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
    image.step, image.is_bigendian = pixels.nbytes // image.height, int(big_endian)
    image.data = array("B", pixels.tobytes())
    return image


def pixels_of(message: Any) -> NDArray:
    """The pixels (height, width, channels) of a `sensor_msgs/Image`, unconverted and in its own byte order.

    Of a planar image the first plane.

    Args:
        message: anything with height, width, encoding, is_bigendian, step (bytes per row) and data.

    Raises:
        ValueError: unknown encoding, or sizes that contradict each other.
    """
    layout = ENCODINGS.get(message.encoding)
    if layout is None:
        raise ValueError(f"encoding = {message.encoding!r}: must be one of {', '.join(ENCODINGS)}")
    kind = np.dtype(layout.type).newbyteorder(">" if message.is_bigendian else "<")
    width, height = int(message.width), int(message.height)
    pixel = layout.channels * kind.itemsize
    step = int(message.step) or width * pixel
    data = np.frombuffer(message.data, np.uint8)
    if step < width * pixel or len(data) < step * height or width * height == 0:
        raise ValueError(
            f"an image of {width} x {height} px {message.encoding} with {step} bytes per row cannot have "
            f"{len(data)} bytes of data"
        )
    return np.ndarray((height, width, layout.channels), kind, data, 0, (step, pixel, kind.itemsize))


def grey(message: Any) -> NDArray:
    """Grey levels (height, width) of a `sensor_msgs/Image`: unscaled, of colours the green channel.

    Of a Bayer pattern, (height / 2, width / 2): the sum of the two green pixels of every four, so that the noise of
    neighbours stays independent.

    Raises:
        ValueError: see `pixels_of`.
    """
    pixels, layout = pixels_of(message), ENCODINGS[message.encoding]
    taken = pixels[..., layout.channel]
    if layout.green is not None:
        rows, columns = (side // 2 * 2 for side in taken.shape)
        upper, lower = (taken[row:rows:2, column:columns:2] for row, column in enumerate(layout.green))
        return np.add(upper, lower, dtype=np.uint32)
    return taken if taken.dtype.isnative else taken.astype(taken.dtype.newbyteorder("="))


def exposure_fault(image: NDArray) -> str:
    """Fault in the exposure of grey levels (H, W): black or NaN, almost black, many at the largest value; "" = none."""
    top = np.fmax.reduce(image, axis=None)  # leaves NaN out
    if not top > 0:
        return "the image is black"
    if image.dtype.kind == "u" and np.mean(image > 1) < HOT_PIXELS:  # numbers of other types have any scale
        return "the image is almost black: its grey levels are 0 and 1, except for a few hot pixels"
    share = float(np.mean(image == top))
    if share < CLIPPED:
        return ""
    return f"{100 * share:.0f} % of its pixels have the largest value, {top:g}: over- or underexposed?"


class SettledGate:
    """Decides by time stamps which images were exposed after a move had ended and settled.

    All times in s of one clock.

    Args:
        settle_time: wait after the last write to the electronics [s].
        stamp_lead: by how much the exposure began before the image's stamp [s]; 0 = stamps mark its beginning.
        ahead: longest time by which an exposure may seem to begin after its image has arrived [s].

    Attributes:
        settled_at: when the shape of the last move has settled; inf = not known yet.
    """

    def __init__(self, settle_time: float, stamp_lead: float = 0.0, ahead: float = STAMP_AHEAD) -> None:
        self._settle_time = settle_time
        self._stamp_lead = stamp_lead
        self._ahead = ahead
        self._sent_at = math.inf
        self._arrives_at = math.inf
        self.settled_at = math.inf

    def sent(self, stamp: float, duration: float = 0.0) -> None:
        """Note that a command was sent at `stamp`; its move is predicted to end `duration` later."""
        self._sent_at = stamp
        self._arrives_at = stamp + duration
        self.settled_at = math.inf

    def written(self, stamp: float, moving: bool, reached: bool) -> None:
        """Note the driver's last write at `stamp`; `reached`: whether the signals written are those of the command.

        A report older than the command counts only if nothing had to move. A report of other signals may be from before
        the driver received the command: then the move ends at the predicted time at the earliest.
        """
        if math.isinf(self.settled_at) and not moving and (stamp >= self._sent_at or reached):
            earliest = self._sent_at if reached else self._arrives_at
            self.settled_at = max(stamp, earliest) + self._settle_time

    def open_for(self, stamp: float, now: float = math.inf) -> bool:
        """Whether an image with this stamp, which has arrived at `now`, was exposed after the shape had settled."""
        return self.settled_at <= stamp - self._stamp_lead <= now + self._ahead

    def reason(self, newest: float | None, apart: float, timeout_s: float, now: float = math.inf) -> str:
        """Why no image has counted within a time.

        Args:
            newest: stamp of the latest image that came meanwhile; None = none did.
            apart: time between it and the one before [s]; 0 = not known.
            timeout_s: how long was waited for an image.
            now: when it came.
        """
        if newest is not None and newest - self._stamp_lead > now + self._ahead:
            ahead = newest - self._stamp_lead - now
            return f"the newest seems exposed {ahead:.3f} s ahead of this node's clock; do the clocks agree?"
        if 2 * apart > timeout_s:  # one period may pass until an exposure begins, and another until it has arrived
            return f"the camera takes one image in {apart:.3g} s; image_timeout must be above {2 * apart:.3g} s"
        if newest is None:
            return "none came; is the camera running?"
        if newest == 0:
            return "their header.stamp is 0, so their focus is not known; it must be above 0"
        if not self.open_for(newest):
            early = self.settled_at + self._stamp_lead - newest
            why = "does the camera still run, do the clocks agree?"
            return f"the newest was exposed {early:.3f} s before the shape was reached; {why}"
        return "they stopped coming"
