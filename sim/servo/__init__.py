"""Simulated Dynamixel servos on a simulated bus: byte-true Protocol 2.0 on the virtual clock."""

from sim.servo.bus import Frame, ServoBus, Source
from sim.servo.device import XSeriesServo
from sim.servo.serial import SimSerial

__all__ = ["Frame", "ServoBus", "SimSerial", "Source", "XSeriesServo"]
