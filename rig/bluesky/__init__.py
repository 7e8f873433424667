"""The bench for bluesky (extra ``bluesky``): devices for a RunEngine, and enroll and identify as plans.

Decision: docs/decisions/0020.
"""

from rig.bluesky.devices import BenchDevices, CameraDevice, ImuDevice, TableDevice
from rig.bluesky.plans import enroll, identify

__all__ = ["BenchDevices", "CameraDevice", "ImuDevice", "TableDevice", "enroll", "identify"]
