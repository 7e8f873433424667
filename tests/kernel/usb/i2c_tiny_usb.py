"""A played i2c-tiny-usb: an I2C adapter for the driver of that name.

Source: the kernel's drivers/i2c/busses/i2c-tiny-usb.c.
"""

import struct
from errno import ETIMEDOUT
from typing import Final

import smbus2

from sim.i2c import SimI2cBus
from sim.realtime.pace import RealTime
from tests.kernel.usb.descriptors import Identity, Speed, configuration, interface
from tests.kernel.usb.device import Request, UsbDevice
from tests.kernel.usb.usbip import Hang, Stall

_TRANSFER, _LAST = 4, 2
_ACKNOWLEDGED, _NOT_ACKNOWLEDGED = b"\x01", b"\x02"
CAN: Final = int(smbus2.I2cFunc.I2C | smbus2.I2cFunc.SMBUS_EMUL)


class I2cTinyUsb(UsbDevice):
    """An I2C adapter in front of a simulated bus, in real time. While the bus is stuck, it does not answer."""

    identity = Identity(0x0403, 0xC631, 0x0105, "Till Harbaum", "i2c-tiny-usb", "0001", 0x110, (255, 0, 0), 8)
    speed = Speed.FULL
    configuration = configuration([interface(0, (255, 0, 0))])

    def __init__(self, bus: SimI2cBus, time: RealTime) -> None:
        self._bus = bus
        self._time = time
        self._status = _ACKNOWLEDGED
        super().__init__()

    def request(self, request: Request) -> bytes:
        match request.number:
            case 1:
                return struct.pack("<I", CAN)
            case 2:
                return b""
            case 3:
                return self._status
            case number if number & ~3 == _TRANSFER:
                return self._transfer(request)
        raise Stall

    def _transfer(self, request: Request) -> bytes:
        last = bool(request.number & _LAST)
        content = request.length if request.reading else request.data
        self._status = _ACKNOWLEDGED
        with self._time.present():
            try:
                return self._bus.message(request.index & 0x7F, content, last=last)
            except OSError as error:
                if error.errno == ETIMEDOUT:
                    raise Hang from error
                self._status = _NOT_ACKNOWLEDGED
        return bytes(request.length) if request.reading else b""
