"""All checks of a bench, in their order."""

from rig.doctor import computer, stored
from rig.doctor.camera import camera
from rig.doctor.examination import Check
from rig.doctor.imu import imu
from rig.doctor.servo import servo

CHECKS = (
    Check("bench", computer.bench_state),
    Check("port", computer.ports),
    # Between two findings it may scan eight baud rates; a broadcast at 9,600 baud takes four seconds.
    Check("servo", servo, deadline_s=60.0),
    Check("imu", imu),
    Check("camera", camera, deadline_s=20.0),
    Check("disk", computer.disk),
    Check("clock", computer.clock),
    Check("catalog", stored.catalog, deadline_s=30.0),
    Check("calibration", stored.calibrations),
)
"""The devices are checked before their calibrations, which are bound to the devices found."""
