"""What is expected of an enrollment and of an identification under each fault of the vocabulary.

``found`` and ``then`` are the columns of `docs/faults.md` that no program can write; the others are measured.
"""

from dataclasses import dataclass
from enum import Enum

FOUND = "found"
"""An identification that names the object that stands there."""
BOOT_S = 0.5


class Step(Enum):
    """What the operator must do before the table moves again."""

    ACKNOWLEDGE = "`rig acknowledge`"
    REBOOT = "`rig acknowledge --reboot`"
    HOME = "`rig home --turns 0`"


class After(Enum):
    """How an enrollment that ended early goes on once the cause is gone."""

    DONE = "by itself"
    RESUME = "`--resume`"
    REPLACE = "`--replace`"


ACK = Step.ACKNOWLEDGE


@dataclass(frozen=True)
class Scenario:
    """One fault.

    Attributes
    ----------
    fault
        As it happens to the enrollment.
    code
        Of the error that ends the enrollment; None where it is completed.
    found
        How it is found, in words.
    after
        How the enrollment goes on.
    identify
        As it happens to the identification; the same, in its first move, where not given.
    answer
        The code that ends the identification, or `FOUND`, or None for an object called unknown.
    then
        What the operator does first, in words.
    step
        Without which nothing moves afterwards.
    shown
        Whether the stored pictures show the object, and so its angle.
    torque
        Whether the servo must be left holding the shaft: it cannot be told anything.
    """

    fault: str
    code: int | None
    found: str
    after: After = After.DONE
    identify: str = ""
    answer: int | str | None = FOUND
    then: str = ""
    step: Step | None = None
    shown: bool = True
    torque: bool = False

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
    """Return the scenario of a fault that ends both plans alike."""
    values: dict[str, object] = {"after": After.RESUME, "answer": code} | more
    return Scenario(fault, code, found, then=then, **values)  # type: ignore[arg-type]


def survived(fault: str, found: str, **more: object) -> Scenario:
    """Return the scenario of a fault that both plans outlive."""
    return Scenario(fault, None, found, **more)  # type: ignore[arg-type]


SILENT = "every transaction is repeated `servo.retries` times, then the servo counts as silent"
SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        # -- the servo -------------------------------------------------------------------------------------------
        stopped("servo.off@move3", 402, SILENT, "give the servo its supply", step=Step.HOME),
        stopped(
            "servo.stuck@move3", 509, "the encoder's angle does not change", "restart the servo", answer=502, step=ACK
        ),
        stopped("servo.garbage@move3", 404, "readings that no servo can have", "restart the servo", step=ACK),
        stopped(
            "servo.wrong@move3",
            502,
            "encoder and gyro disagree",
            "mount the magnet",
            after=After.REPLACE,
            answer=FOUND,
            step=ACK,
        ),
        survived("servo.slow", "not at all: an answer within the timeout is as good as a fast one"),
        stopped("servo.delayed", 502, "encoder and gyro disagree in the return to 0", "restart the servo", step=ACK),
        survived("servo.intermittent", "timeouts; each transaction is repeated, and counted"),
        # -- the gyro --------------------------------------------------------------------------------------------
        stopped("imu.off@move3", 402, "no acknowledge, after three attempts", "plug the sensor in"),
        stopped("imu.stuck@move3", 404, "equal samples: noise alone would change them", "restart the sensor", step=ACK),
        stopped("imu.garbage@move3", 502, "encoder and gyro disagree", "restart the sensor", step=ACK),
        stopped("imu.wrong@move3", 502, "encoder and gyro disagree", "change the sensor, or calibrate it", step=ACK),
        stopped(
            "imu.slow@move3",
            404,
            "samples are missing: the table never counts as at rest",
            "restart the sensor",
            step=ACK,
        ),
        stopped(
            "imu.delayed@move3",
            404,
            "the gyro tells of a turn while the encoder stands",
            "restart the sensor",
            answer=502,
            step=ACK,
        ),
        stopped(
            "imu.intermittent@move3", 404, "the sensor fell asleep and lost its settings", "mend its supply", step=ACK
        ),
        # -- the camera ------------------------------------------------------------------------------------------
        stopped("camera.off@move3", 402, "five frames in a row fail", "plug the camera in"),
        stopped("camera.stuck@move3", 402, "no frame within the time-out", "open the camera anew"),
        stopped("camera.garbage@move3", 600, "the picture is noise", "change the cable"),
        stopped("camera.wrong@move3", 404, "a frame of another size than the camera's", "open the camera anew"),
        survived("camera.slow", "not at all: a view takes as long as the next frame"),
        survived("camera.delayed", "frames are chosen by their time stamp, late ones too"),
        survived("camera.intermittent", "a frame that fails is fetched again, four times at most"),
        # -- the servo's line, supply, load and gears ------------------------------------------------------------
        survived("crc_flip", "CRC; the transaction is repeated, and counted"),
        survived(
            "late_reply:rate=0.02",
            "length and quiet line: after a timeout the line is drained before the next question",
        ),
        survived("babble", "bytes that are no packet are skipped, within a deadline"),
        survived("echo", "the adapter's echo is no status packet, and is skipped"),
        stopped(
            "unplug@move3",
            402,
            "the port fails; the servo's own watchdog stops the table",
            "plug the adapter in",
            torque=True,
        ),
        stopped("brownout@move3", 402, SILENT, "mend the supply", step=Step.HOME),
        stopped("overload@move3", 404, "the alert bit of every answer", "let it cool down", step=Step.REBOOT),
        stopped("overheat@move3", 404, "the alert bit of every answer", "let it cool down", step=Step.REBOOT),
        stopped("watchdog_trip@move3", 510, "the servo's watchdog register", "find what kept the computer busy"),
        stopped("duplicate_id@move3", 402, "answers spoil each other: no valid packet", "give each servo its own id"),
        stopped("wrong_model", 401, "Model Number, when the bench is opened", "connect the right servo"),
        stopped(
            "backlash@move3",
            502,
            "encoder and gyro disagree",
            "mend the gears",
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
        stopped(
            "jam@move3",
            509,
            "the encoder's angle does not change, or the load is high",
            "free it",
            answer=505,
            step=ACK,
        ),
        # -- the gyro's bus and range ----------------------------------------------------------------------------
        survived("i2c_nack", "errno; the transfer is repeated, and counted"),
        stopped("i2c_stuck@move3", 402, "the kernel's timeout, three times", "power-cycle the sensor"),
        stopped(
            "imu_saturated@move3",
            404,
            "the gyro's rate stands at the end of its range",
            "restart the sensor",
            step=ACK,
        ),
        # -- pictures --------------------------------------------------------------------------------------------
        stopped("frozen_frame@move3", 600, "two equal frames", "open the camera anew", answer=FOUND),
        stopped("black_frame@move3", 600, "mean level and share of black pixels", "take the cap off"),
        stopped("blur@move3", 600, "variance of the Laplacian", "focus"),
        stopped("exposure_jump@move3", 600, "the camera's locks, read back with every frame", "open the camera anew"),
        survived(
            "light_flicker", "not at all at this depth: CEDD hardly sees it; the mean level is kept with each view"
        ),
        # -- around ----------------------------------------------------------------------------------------------
        stopped(
            "object_falls@move3",
            601,
            "the last view, taken at 0 again, does not look like the first",
            "put the object back",
            after=After.REPLACE,
            answer=FOUND,
            shown=False,
        ),
        stopped("disk_full@move3", 700, "the write that is to be durable", "free some space", answer=FOUND),
        survived(
            "clock_jump@view3", "not at all: time is measured on the monotonic clock", identify="clock_jump@view0"
        ),
    )
}
