"""Identity and status of a rig head, and the errors that follow from them."""

from dataclasses import dataclass, field
from typing import Any

from rig.config.imus import likely_device
from rig.core.errors import (
    DeviceFault,
    DeviceMismatch,
    DeviceSilent,
    EmergencyStop,
    HeadRestarted,
    HeartbeatLost,
    RigError,
)
from rig.core.next_steps import Do
from rig.devices.head.protocol import HeadFault, HeadState, HeartbeatReply, ImuStatus, Input, Reset, StatusChanged
from rig.devices.head.samples import HeadSensor
from rig.devices.imu import ImuIdentity

_RESTARTS = {
    Reset.UNKNOWN: "for an unknown reason",
    Reset.POWER_ON: "because its supply was off",
    Reset.EXTERNAL: "because of a reset (its button, or opening its port)",
    Reset.BROWN_OUT: "because its supply voltage was too low (brown-out)",
    Reset.WATCHDOG: "because its program hung (watchdog)",
}


@dataclass(frozen=True, slots=True)
class HeadIdentity(ImuIdentity):
    """The sensor and its rig head; ``serial`` is None if the board has no serial number."""

    board: str
    firmware: str
    protocol: int
    serial: int | None


@dataclass(frozen=True, slots=True)
class HeadStatus:
    """The last status that the head sent."""

    state: HeadState = HeadState.IDLE
    faults: HeadFault = field(default_factory=lambda: HeadFault(0))
    estop_open: bool = False
    relay_closed: bool = False
    imu_status: ImuStatus = ImuStatus.OFF
    who_am_i: int = 0

    @classmethod
    def of(cls, message: HeartbeatReply | StatusChanged) -> "HeadStatus":
        """Return the status in a message; raises ValueError for values that this protocol does not have."""
        return cls(
            state=HeadState(message.state),
            faults=HeadFault(message.faults),
            estop_open=bool(message.inputs & Input.ESTOP_OPEN),
            relay_closed=bool(message.inputs & Input.RELAY_CLOSED),
            imu_status=ImuStatus(message.imu_status),
            who_am_i=message.who_am_i,
        )


def head_fault(
    status: HeadStatus, *, port: str, restart: Reset | None, start: Reset, deadman_ms: int
) -> RigError | None:
    """Return the error for the reason why the head switched its outputs off; None if it did not.

    ``restart`` is the cause of a restart while the head was in use, ``start`` that of its start before it was opened.
    """
    faults = status.faults
    evidence: dict[str, Any] = {"faults": faults.name, "port": port}
    if HeadFault.ESTOP in faults:
        return EmergencyStop(
            "The e-stop is pressed, or its loop is open: light and servo power are off.",
            next_step=("Look at the bench, then release the e-stop or repair its cable.", Do.ACKNOWLEDGE()),
            evidence=evidence,
        )
    if restart is not None or faults & (HeadFault.BROWN_OUT | HeadFault.WATCHDOG):
        cause = start if restart is None else restart
        return HeadRestarted(
            f"The rig head at {port} restarted {_RESTARTS[cause]}: light and servo power went off.",
            next_step=("Check its supply and USB cable.", Do.ACKNOWLEDGE()),
            evidence={**evidence, "reset_cause": cause.name.lower()},
        )
    if HeadFault.DEADMAN in faults:
        return HeartbeatLost(
            f"The rig head received nothing from this computer for {deadman_ms} ms: light and servo power are off.",
            next_step=(
                "Check whether a program was killed or a cable unplugged. If not, increase head.deadman_s.",
                Do.ACKNOWLEDGE(),
            ),
            evidence={**evidence, "deadman_ms": deadman_ms},
        )
    return None


def sensor_error(status: HeadStatus, sensor: HeadSensor, port: str) -> RigError:
    """Return the error for a sensor that does not run."""
    place = f"I2C address {sensor.setup.address:#04x} of the rig head at {port}"
    evidence = {"imu_status": status.imu_status.name.lower()}
    match status.imu_status:
        case ImuStatus.WRONG_ID:
            (expected,) = sensor.kind.identities
            likely = likely_device(sensor.kind, sensor.setup.address, status.who_am_i)
            return DeviceMismatch(
                f"WHO_AM_I at {place} is {status.who_am_i:#04x}, expected {expected:#04x} ({sensor.kind.name}): "
                f"probably {likely}.",
                next_step="Check the wiring, imu.model and imu.address.",
                evidence={"got": status.who_am_i, "expected": expected},
            )
        case ImuStatus.BUS_STUCK:
            return DeviceSilent(
                f"The I2C bus of the rig head at {port} is stuck: SDA or SCL is held low.",
                next_step="Check SDA and SCL for a short, then switch the sensor's supply off and on.",
                evidence=evidence,
            )
        case ImuStatus.SETTINGS_LOST:
            return DeviceFault(
                f"The {sensor.kind.name} at {place} loses its settings: its supply is interrupted.",
                next_step="Check its supply and cable, then open the bench again.",
                evidence=evidence,
            )
        case _:
            return DeviceSilent(
                f"The {sensor.kind.name} at {place} does not answer.",
                next_step="Check the sensor's plug, supply, SDA and SCL, and its address (imu.address).",
                evidence=evidence,
            )
