"""All checks of a bench, in the order in which a person would look."""

from rig.doctor import computer, stored
from rig.doctor.camera import camera
from rig.doctor.examination import Check
from rig.doctor.imu import imu
from rig.doctor.servo import servo

CHECKS = (
    Check("bench", computer.bench_state),
    Check("port", computer.ports),
    # One finding of it may be the answer of eight baud rates, at 9,600 of which a broadcast takes four seconds.
    Check("servo", servo, deadline_s=60.0),
    Check("imu", imu),
    Check("camera", camera, deadline_s=20.0),
    Check("disk", computer.disk),
    Check("clock", computer.clock),
    Check("catalog", stored.catalog, deadline_s=30.0),
    Check("calibration", stored.calibrations),
)
"""Those of the devices come before that of their calibrations, which hold for the devices that were met."""
