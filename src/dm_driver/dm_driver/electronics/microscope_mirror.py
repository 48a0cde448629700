"""Deformable mirrors that python-microscope drives, over its device server: ALPAO, Boston Micromachines, Mirao 52e, ...

That program takes a pattern of numbers from 0 to 1, one for each actuator, in no unit: `volts.*` of the driver
are these numbers (0 and 1 at the ends, `amplifier_gain` 1), since the volts behind them cannot be known here.
"""

import select
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dm_common import Bools
from dm_driver.electronics.base import DriveElectronics, ElectronicsSettings, LinkError


class MicroscopeMirror(DriveElectronics):
    """A `DeformableMirror` of python-microscope. One pattern sets all actuators, connected or not.

    Pyro4, through which its device server talks, is imported when the link is opened; it sends arrays as pickles, so
    the server must be one that is trusted.
    """

    max_code = 0xFFFF
    knows_volts = False
    needs = ("address", "the URI of the mirror on the device server, such as PYRO:Mirao52e@127.0.0.1:8000")

    def __init__(self, settings: ElectronicsSettings) -> None:
        super().__init__(settings)
        self.channels = settings.channels

    @property
    def where(self) -> str:
        return f"deformable mirror at {self._settings.address}"

    def _do_open(self) -> None:
        try:
            import Pyro4
        except ImportError as error:
            raise LinkError(
                "python-microscope needs the package Pyro4: ./dm exec python -m pip install Pyro4"
            ) from error
        self._link = self._call(lambda: Pyro4.Proxy(self._settings.address))
        self._link._pyroSerializer, self._link._pyroTimeout = "pickle", self._timeout_s
        actuators = self._call(lambda: self._link.n_actuators)
        if actuators != self.channels:
            raise LinkError(f"has {actuators} actuators, mirror.actuators is {self.channels}")

    def _do_write(self, codes: NDArray[np.uint16], wired: Bools) -> None:
        self._call(lambda: self._link.apply_pattern(codes / self.max_code))

    def _do_check(self) -> None:
        # The server sends nothing unasked: a readable link has ended.
        if select.select([self._link._pyroConnection.sock], [], [], 0.0)[0]:
            raise LinkError("the device server closed the link")

    def _do_close(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link._pyroRelease()

    def _call(self, call: Callable[[], Any]) -> Any:
        """The result of `call`; any failure there, also in the manufacturer's library, breaks the link, since the
        outputs are then unknown.
        """
        try:
            return call()
        except Exception as error:
            raise LinkError(str(error)) from error
