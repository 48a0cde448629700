"""Drive electronics behind one small class, chosen by name.

A further drive unit is one subclass of :class:`~dm_driver.electronics.base.DriveElectronics` and one line in
`BACK_ENDS`; a serial one that takes whole frames needs neither, see :mod:`dm_driver.electronics.frame_format`.
"""

from dm_driver.electronics.base import DriveElectronics
from dm_driver.electronics.edac40 import Edac40Tcp, Edac40Udp
from dm_driver.electronics.framed_serial import FramedSerial
from dm_driver.electronics.microscope_mirror import MicroscopeMirror
from dm_driver.electronics.usb_dac40 import UsbDac40

BACK_ENDS: dict[str, type[DriveElectronics]] = {
    "edac40_tcp": Edac40Tcp,
    "edac40_udp": Edac40Udp,
    "usb_dac40": UsbDac40,
    "framed_serial": FramedSerial,
    "microscope": MicroscopeMirror,
}
