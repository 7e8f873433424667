"""Simulated Dynamixel servos on a simulated bus: byte-true Protocols 1.0 and 2.0 on the virtual clock."""

from sim.servo.ax12 import Ax12Servo
from sim.servo.bus import Sender, SentBytes, ServoBus
from sim.servo.device import XSeriesServo
from sim.servo.serial import SimSerial
from sim.servo.shaft import Geared

__all__ = ["Ax12Servo", "Geared", "Sender", "SentBytes", "ServoBus", "SimSerial", "XSeriesServo"]
