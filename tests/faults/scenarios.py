"""The expected outcome of an enrollment and of an identification under each simulated fault.

``found`` and ``then`` are texts of `docs/reference/faults.md`; its other columns are measured.
"""

from dataclasses import dataclass
from enum import Enum

FOUND = "found"
"""The identification names the object on the table."""
BOOT_S = 0.5


class Step(Enum):
    """The command that the operator must run before the table moves again."""

    ACKNOWLEDGE = "`rig acknowledge`"
    REBOOT = "`rig acknowledge --reboot`"
    HOME = "`rig home --revolutions 0`"


class After(Enum):
    """How a stopped enrollment continues after the cause is removed."""

    DONE = "automatic"
    RESUME = "`--resume`"
    REPLACE = "`--replace`"


ACK = Step.ACKNOWLEDGE


@dataclass(frozen=True)
class Scenario:
    """A fault and its expected outcomes."""

    fault: str
    """The fault during the enrollment, in the short notation."""
    code: int | None
    """Code of the error that stops the enrollment; None if it completes."""
    found: str
    """How the rig detects the fault, in words."""
    after: After = After.DONE
    """How the enrollment continues."""
    identify: str = ""
    """The fault during the identification; default: the same fault during its first move."""
    answer: int | str | None = FOUND
    """Code of the error that stops the identification, or `FOUND`, or None for an unknown object."""
    then: str = ""
    """What the operator does first, in words."""
    step: Step | None = None
    """The command without which the table does not move."""
    shown: bool = True
    """Whether the stored images show the object, and with it the angle."""
    torque: bool = False
    """Whether the servo's torque stays on because the servo cannot be reached."""
    late: bool = False
    """Whether the enrollment detects the fault only at its end, or only in a large move."""

    @property
    def name(self) -> str:
        return self.fault.partition("@")[0].partition(":")[0]

    @property
    def of_identification(self) -> str:
        return self.identify or self.at_move(1)

    def at_move(self, number: int) -> str:
        """Return the fault of the enrollment, during another move or after another view."""
        return self.fault.replace("@move3", f"@move{number}").replace("@view3", f"@view{number}")


def stopped(fault: str, code: int, found: str, then: str, **more: object) -> Scenario:
    """Return the scenario of a fault that stops both plans with the same code."""
    values: dict[str, object] = {"after": After.RESUME, "answer": code} | more
    return Scenario(fault, code, found, then=then, **values)  # type: ignore[arg-type]


def survived(fault: str, found: str, **more: object) -> Scenario:
    """Return the scenario of a fault that stops neither plan."""
    return Scenario(fault, None, found, **more)  # type: ignore[arg-type]


SILENT = "no answer after `servo.retries` repetitions of a transaction"
SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        # -- the servo -------------------------------------------------------------------------------------------
        stopped("servo.off@move3", 402, SILENT, "connect the servo's supply", step=Step.HOME),
        stopped(
            "servo.stuck@move3", 509, "the encoder's angle does not change", "restart the servo", answer=502, step=ACK
        ),
        stopped("servo.garbage@move3", 404, "the readings are impossible", "restart the servo", step=ACK),
        stopped(
            "servo.wrong@move3",
            502,
            "encoder and gyro disagree",
            "fasten the magnet",
            after=After.REPLACE,
            answer=FOUND,
            step=ACK,
        ),
        survived("servo.slow", "not detected: answers within the timeout are valid"),
        stopped(
            "servo.delayed",
            502,
            "encoder and gyro disagree in a move of more than 10°",
            "restart the servo",
            step=ACK,
            late=True,
        ),
        survived("servo.intermittent", "timeout; the transaction is repeated and counted"),
        # -- the gyro --------------------------------------------------------------------------------------------
        stopped("imu.off@move3", 402, "no acknowledge in three attempts", "connect the sensor"),
        stopped("imu.stuck@move3", 404, "samples are equal, without noise", "restart the sensor", step=ACK),
        stopped("imu.garbage@move3", 502, "encoder and gyro disagree", "restart the sensor", step=ACK),
        stopped("imu.wrong@move3", 502, "encoder and gyro disagree", "replace or calibrate the sensor", step=ACK),
        stopped(
            "imu.slow@move3",
            404,
            "samples are missing, so settling does not end",
            "restart the sensor",
            step=ACK,
        ),
        stopped(
            "imu.delayed@move3",
            502,
            "the gyro reports rotation, the encoder does not",
            "restart the sensor",
            answer=502,
            step=ACK,
        ),
        stopped(
            "imu.intermittent@move3",
            404,
            "the sensor is in sleep mode without its settings",
            "repair its supply",
            step=ACK,
        ),
        survived("imu.bursts:longest=0.3@move3", "the sensor's FIFO keeps the samples"),
        # -- the camera ------------------------------------------------------------------------------------------
        stopped("camera.off@move3", 402, "five consecutive frames fail", "connect the camera"),
        stopped("camera.stuck@move3", 402, "no frame within the timeout", "reconnect the camera"),
        stopped("camera.garbage@move3", 600, "the image is noise", "replace the cable"),
        stopped("camera.wrong@move3", 404, "the frame has a wrong size", "reconnect the camera"),
        survived("camera.slow", "not detected: each view waits for its frame"),
        survived("camera.delayed", "not detected: frames are selected by time stamp"),
        survived("camera.intermittent", "a failed frame is fetched again, at most four times"),
        survived("lost_frames", "not detected at rest: each view waits for its frame"),
        survived("doubled_frame", "two equal frames; the view is taken again"),
        survived("stamp_jump", "not detected at rest: a view is exposed long after the table came to rest"),
        survived("stamps_backwards", "time stamps that go backwards are not used; a frame counts from its arrival"),
        survived("stamp_jitter", "not detected at rest: a view is exposed long after the table came to rest"),
        # -- the servo's bus, supply, load and gears -------------------------------------------------------------
        survived("crc_flip", "CRC; the transaction is repeated and counted"),
        survived(
            "late_reply:rate=0.02",
            "after a timeout the bus is drained before the next request",
        ),
        survived("duplicate_reply", "the length of the answer, and the servo's clock in it"),
        survived("babble", "bytes that are not a packet are skipped until the timeout"),
        survived("echo", "the echo is not a status packet and is skipped"),
        stopped(
            "unplug@move3",
            402,
            "the port fails; the servo's watchdog stops the table",
            "connect the adapter",
            torque=True,
        ),
        stopped("brownout@move3", 402, SILENT, "repair the supply", step=Step.HOME),
        stopped("overload@move3", 404, "the alert bit in the answers", "let the servo cool down", step=Step.REBOOT),
        stopped("overheat@move3", 404, "the alert bit in the answers", "let the servo cool down", step=Step.REBOOT),
        stopped("watchdog_trip@move3", 510, "the servo's watchdog register", "find out what blocked the computer"),
        stopped("duplicate_id@move3", 402, "the answers collide and no packet is valid", "give each servo its own id"),
        stopped("wrong_model", 401, "the model number, when the bench opens", "connect the configured servo"),
        stopped(
            "backlash@move3",
            502,
            "encoder and gyro disagree",
            "repair the gears",
            after=After.REPLACE,
            answer=FOUND,
            step=ACK,
        ),
        stopped(
            "slip@move3",
            502,
            "encoder and gyro disagree",
            "tighten the platter",
            after=After.REPLACE,
            answer=FOUND,
            step=ACK,
        ),
        survived(
            "friction", "the rig checks arrival by the end of the profile, standing still and `table.tolerance_deg`"
        ),
        stopped(
            "jam@move3",
            509,
            "the encoder's angle does not change, or the load is high",
            "free the shaft",
            answer=505,
            step=ACK,
        ),
        # -- the gyro's bus and range ----------------------------------------------------------------------------
        survived("i2c_nack", "transfer error; the transfer is repeated and counted"),
        stopped("i2c_stuck@move3", 402, "three timeouts of the kernel", "power-cycle the sensor"),
        stopped(
            "i2c_hang@move3",
            422,
            "four timeouts of this adapter, the last one after the bus was opened again",
            "power-cycle the computer",
        ),
        stopped(
            "imu_saturated@move3",
            404,
            "the gyro's rate is the maximum of its range",
            "restart the sensor",
            step=ACK,
        ),
        # -- images ----------------------------------------------------------------------------------------------
        stopped("frozen_frame@move3", 600, "two equal frames", "reconnect the camera", answer=FOUND),
        stopped("black_frame@move3", 600, "mean level and share of black pixels", "remove the lens cap"),
        stopped("blur@move3", 600, "variance of the Laplacian", "focus the camera"),
        stopped("exposure_jump@move3", 600, "the exposure settings, read with every frame", "reconnect the camera"),
        survived("light_flicker", "not detected at this depth: it hardly changes CEDD; views store their mean level"),
        survived("mains_flicker", "not visible at the default exposure of 10 ms; `rig doctor` names it at others"),
        # -- object and computer ---------------------------------------------------------------------------------
        stopped(
            "object_falls@move3",
            601,
            "a last view at home differs from the first view",
            "put the object back",
            after=After.REPLACE,
            answer=FOUND,
            shown=False,
            late=True,
        ),
        stopped(
            "object_moved@move3",
            601,
            "a last view at home differs from the first view; a search compares each new view with the views before",
            "put the object back",
            after=After.REPLACE,
            identify="object_moved:other=0@move1",
            answer=FOUND,
            shown=False,
            late=True,
        ),
        stopped("disk_full@move3", 700, "a write fails", "free some disk space", answer=FOUND),
        survived("clock_jump@view3", "not detected: durations use the monotonic clock", identify="clock_jump@view0"),
    )
}
