"""Simulated Dynamixel servos on a simulated bus: byte-true Protocol 2.0 on the virtual clock."""

from sim.servo.bus import Sender, SentBytes, ServoBus
from sim.servo.device import SimServo
from sim.servo.serial import SimSerial

__all__ = ["Sender", "SentBytes", "ServoBus", "SimSerial", "SimServo"]
