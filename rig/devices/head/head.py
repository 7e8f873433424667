"""The rig head: an IMU with its own clock, the light, the e-stop and the servo's power.

The head sends samples by itself, dated by its clock. A heartbeat in the background keeps its outputs on and compares
the clocks. When the program dies, the heartbeat ends and the head switches its outputs off.

Decision: docs/decisions/0003.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.config import HeadConfig, RigConfig
from rig.core.clock import Clock, seconds_between
from rig.core.errors import (
    DeviceFault,
    DeviceSilent,
    EmergencyStop,
    HeadRestarted,
    HeartbeatLost,
    RequestRejected,
    RigError,
)
from rig.core.next_steps import Do
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head.link import HeadLink, version
from rig.devices.head.protocol import (
    SERIAL_UNSET,
    Acknowledge,
    Board,
    Done,
    HeadFault,
    HeadState,
    HeartbeatReply,
    ImuStatus,
    Input,
    Light,
    Rejection,
    Relay,
    Reset,
    Sample,
    Shutdown,
    StatusChanged,
    Stream,
)
from rig.devices.head.samples import HeadClock, HeadSensor, SampleStream, head_sensor
from rig.devices.imu import ImuIdentity, ImuSamples, another_sensor
from rig.devices.mpu6050 import Mpu6050Clone, check_clone

POWER_UP_S = 0.6
"""Time from closing the relay of the servo's supply until the servo answers."""
HEARTBEATS_PER_DEADMAN = 4  # three may be lost or late before the head switches off; more: more traffic on its port
FIRST_HEARTBEATS = 8
"""Heartbeats that compare the clocks before the first sample is dated."""
RECOVERY_S = 0.5  # the head tries every 0.1 s
"""Longest time that the head may take to set its sensor up again."""


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


class RigHead:
    """An open rig head; implements `rig.devices.imu.Imu`.

    Opening it greets the head, compares the clocks, sets the sensor up and starts the stream. The outputs stay off.

    ``connection``, ``name`` and ``reopen`` are as for `HeadLink`, at `protocol.BAUD`. After a silence of ``deadman_s``
    the head switches its outputs off.

    Raises `DeviceNotFound`, `FirmwareMismatch`: as `HeadLink.greet`. `DeviceSilent`, `DeviceMismatch`: the sensor on
    the head does not answer, or is another one.
    """

    def __init__(
        self,
        connection: SerialConnection,
        clock: Clock,
        sensor: HeadSensor,
        *,
        deadman_s: float = 0.25,
        name: str = "head",
        reopen: Callable[[], SerialConnection] | None = None,
    ) -> None:
        # What the head has said of itself, and what the program knows of the connection.
        self._deadman_ms = round(1000 * deadman_s)
        self._clock = clock
        self._sensor = sensor
        self._lock = Lock()
        self._sensor_lost_ns = clock.now_ns()
        self._status = HeadStatus()
        self._restart: Reset | None = None
        self._set_up = self._down = self._closed = False
        self._link = HeadLink(connection, clock, self._on_event, name, reopen)
        self.statistics = self._link.statistics
        self._timing = HeadClock(2 * self._link.frame_ns(HeartbeatReply.LAYOUT.size))
        self._stream = SampleStream(sensor, clock, self._timing, self.statistics)
        self._heartbeat_ns = clock.now_ns()
        self._cancel: Callable[[], None] = lambda: None
        # Open it; after any failure its outputs are off and its port is closed.
        try:
            self._link.greet()
            self._begin()
            self._wait_until_running()
            # Beside the work, not in its control loop: a slow disk or the operator takes longer than a deadman.
            self._cancel = clock.every(deadman_s / HEARTBEATS_PER_DEADMAN, self._in_background)
            if sensor.kind is Mpu6050Clone.KIND:
                check_clone(self, clock, f"of the rig head at {name}")
        except BaseException:
            self.close()
            raise

    # -- IMU --------------------------------------------------------------------------------------------------------

    @property
    def identity(self) -> HeadIdentity:
        head, sensor, boards = self._link.identity, self._sensor, {b.value: b.name.lower() for b in Board}
        return HeadIdentity(
            model=sensor.kind.name,
            bus_address=sensor.setup.address,
            who_am_i=self._status.who_am_i,
            gyro_noise_dps_rthz=sensor.noise_dps_rthz,
            board=boards.get(head.board, f"unknown ({head.board})"),
            firmware=version(head),
            protocol=head.protocol,
            serial=None if head.serial == SERIAL_UNSET else head.serial,
        )

    @property
    def rate_hz(self) -> float:
        return self._sensor.rate_hz

    @property
    def range_dps(self) -> float:
        return self._sensor.range_dps

    def read_samples(self) -> ImuSamples:
        """Return the samples that arrived since the last call, at most those of `stream.MEMORY_S`.

        Raises `DeviceSilent`: the head does not answer and cannot be reconnected, or it lost its sensor.
        `DeviceMismatch`: another head or another sensor answers than the one that was opened.
        """
        with self._in_use():
            self._check_sensor()
            return self._stream.take()

    def read_gravity_g(self) -> NDArray[np.float64]:
        """Return the newest accelerometer reading (3,), in g; raises as `read_samples` does."""
        sample = self._fresh_sample()
        return np.array([sample.accel_x, sample.accel_y, sample.accel_z]) / self._sensor.lsb_per_g

    def temperature_c(self) -> float:
        """Return the temperature of the sensor's die; raises as `read_samples` does."""
        return self._sensor.temperature_c(self._fresh_sample().temperature)

    def close(self) -> None:
        """Switch the outputs and the deadman off, and close the port; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._cancel()
        with self._lock:
            if not self._down:
                with suppress(RigError):  # without an answer, the head's deadman does the same
                    self._link.request(Shutdown(), Done)
            with suppress(OSError):
                self._link.close()

    # -- outputs ----------------------------------------------------------------------------------------------------

    def set_light(self, level: float) -> None:
        """Set the ring light, 0 to 1; raises RequestRejected if a fault is latched."""
        with self._in_use():
            self._link.request(Light(round(255 * min(max(level, 0.0), 1.0))), Done)

    def set_power(self, on: bool) -> None:
        """Close or open the servo's power relay; raises RequestRejected if a fault is latched."""
        with self._in_use():
            self._link.request(Relay(int(on)), Done)

    def switch_on(self, config: HeadConfig) -> RigError | None:
        """Switch on the servo's power and the ring light if they are connected; return the fault that was latched.

        A fault of an earlier program is cleared on the head and returned. The caller latches it, so that the operator
        must acknowledge it before anything moves.

        Raises `EmergencyStop`: the e-stop is pressed, and the servo's supply goes through it.
        """
        fault = self.fault
        if fault is not None:
            try:
                self.acknowledge()
            except EmergencyStop:
                if config.power:
                    raise
                return fault
        if config.power:
            self.set_power(True)
            self._clock.sleep(POWER_UP_S)
        if config.light is not None:
            self.set_light(config.light)
        return fault

    # -- status and faults ------------------------------------------------------------------------------------------

    @property
    def status(self) -> HeadStatus:
        """The head's last status; at most a quarter of the deadman old."""
        return self._status

    @property
    def fault(self) -> RigError | None:
        """The reason why the head switched its outputs off; None if it did not."""
        faults, port, restart = self._status.faults, self._link.name, self._restart
        evidence: dict[str, Any] = {"faults": faults.name, "port": port}
        if HeadFault.ESTOP in faults:
            return EmergencyStop(
                "The e-stop is pressed, or its loop is open: light and servo power are off.",
                next_step=("Look at the bench, then release the e-stop or repair its cable.", Do.ACKNOWLEDGE()),
                evidence=evidence,
            )
        # A restart while the head was in use, or its start before it was opened.
        if restart is not None or faults & (HeadFault.BROWN_OUT | HeadFault.WATCHDOG):
            cause = Reset(self._link.identity.reset_cause) if restart is None else restart
            return HeadRestarted(
                f"The rig head at {port} restarted {_RESTARTS[cause]}: light and servo power went off.",
                next_step=("Check its supply and USB cable.", Do.ACKNOWLEDGE()),
                evidence={**evidence, "reset_cause": cause.name.lower()},
            )
        if HeadFault.DEADMAN in faults:
            return HeartbeatLost(
                f"The rig head received nothing from this computer for {self._deadman_ms} ms: light and servo power "
                "are off.",
                next_step=(
                    "Check whether a program was killed or a cable unplugged. If not, increase head.deadman_s.",
                    Do.ACKNOWLEDGE(),
                ),
                evidence={**evidence, "deadman_ms": self._deadman_ms},
            )
        return None

    def check(self) -> None:
        """Raise the fault for which the head switched its outputs off.

        Raises EmergencyStop, HeartbeatLost, HeadRestarted: see `fault`.
        """
        with self._in_use():
            pass
        if fault := self.fault:
            raise fault

    def acknowledge(self) -> None:
        """Clear the latched faults after the operator looked at their causes; the outputs stay off.

        Raises `EmergencyStop`: the e-stop is still pressed. `DeviceSilent`: the head does not answer.
        """
        with self._in_use():
            try:
                self._link.request(Acknowledge(0xFF), Done)
            except RequestRejected as rejected:
                if rejected.evidence["rejection"] == Rejection.CAUSE_PERSISTS and (fault := self.fault):
                    raise fault from rejected
                raise
            self._restart = None
            self._heartbeat()

    def report(self) -> dict[str, Any]:
        """Return the head's status in words, for people and records."""
        status = self._status
        return {
            "state": status.state.name.lower(),
            "faults": [str(fault.name).lower() for fault in status.faults],
            "estop_open": status.estop_open,
            "relay_closed": status.relay_closed,
            "sensor": status.imu_status.name.lower(),
            "connection": self.health(),
        }

    def health(self) -> dict[str, float]:
        """Return statistics of connection, clock and samples, with units in the names."""
        return {
            **asdict(self.statistics),
            "drift_ppm": round(self._timing.drift_ppm, 1),
            "time_uncertainty_us": round(self._timing.uncertainty_ns / 1000, 1),
        }

    # -- connection -------------------------------------------------------------------------------------------------

    @contextmanager
    def _in_use(self) -> Iterator[None]:
        """Use the head alone: reconnect it if necessary, and process what arrived."""
        with self._lock:
            if self._down:
                if self._closed:
                    raise DeviceSilent(
                        f"The rig head at {self._link.name} is closed.", next_step="Open the bench again."
                    )
                self._link.reconnect()
                self._begin()
                self._down = False
            self._poll()
            yield

    def _in_background(self) -> None:
        """Send a heartbeat and process what arrived, unless the program uses the head right now."""
        if self._lock.acquire(blocking=False):
            try:
                if not self._down and not self._closed:
                    self._poll()
            except RigError:
                pass  # the next use of the head meets the same error and reports it
            finally:
                self._lock.release()

    def _begin(self) -> None:
        """Compare the clocks, set the sensor up and start the stream."""
        self._stream.restart()
        self._timing.restart()
        for _ in range(FIRST_HEARTBEATS):
            self._heartbeat()
        self._link.request(self._sensor.setup, Done)
        self._link.request(Stream(1), Done)
        self._sensor_lost_ns = self._clock.now_ns()
        self._set_up = True

    def _poll(self) -> None:
        try:
            self._link.poll()
            # A head that restarted has lost its sensor's settings, and its clock began again.
            if self._restart is not None and not self._set_up:
                self._link.identify()
                self._restart = Reset(self._link.identity.reset_cause)
                self._begin()
            elapsed_s = seconds_between(self._heartbeat_ns, self._clock.now_ns())
            if elapsed_s * HEARTBEATS_PER_DEADMAN * 1000 >= self._deadman_ms:
                self._heartbeat()
        except DeviceSilent:
            self._down = True
            raise

    def _heartbeat(self) -> None:
        reply = self._link.heartbeat(self._deadman_ms)
        self._heartbeat_ns = self._link.heard_ns
        if not self._take_status(reply):
            received_us, answered_us = self._timing.unwrap(reply.received_us), self._timing.unwrap(reply.sent_us)
            self._timing.add(self._link.sent_ns, received_us, answered_us, self._link.heard_ns)

    def _on_event(self, event: Sample | StatusChanged) -> None:
        if isinstance(event, StatusChanged):
            self._take_status(event)
        elif self._timing.known and self._set_up:
            self._stream.add(event)

    def _take_status(self, message: HeartbeatReply | StatusChanged) -> bool:
        """Store the head's status; return whether it restarted, and so lost its sensor's settings."""
        try:
            status = HeadStatus.of(message)
        except ValueError:
            return False  # no head of this protocol sends such values
        before, self._status = self._status.imu_status, status
        if before == ImuStatus.RUNNING != status.imu_status:
            self._sensor_lost_ns = self._clock.now_ns()
        restarted = self._set_up and status.imu_status == ImuStatus.OFF
        if restarted:
            self._set_up = False
            self._restart = Reset(message.reset_cause) if isinstance(message, StatusChanged) else Reset.UNKNOWN
            self.statistics.restarts += 1
        return restarted

    # -- sensor -----------------------------------------------------------------------------------------------------

    def _wait_until_running(self) -> None:
        deadline_ns = self._clock.now_ns() + round(self._sensor.start_s * 1e9)
        while self._stream.newest is None or self._another_sensor:
            self._poll()
            if self._clock.now_ns() > deadline_ns or self._another_sensor:
                self._heartbeat()
                raise self._sensor_error()
            self._clock.sleep(0.005)

    @property
    def _another_sensor(self) -> bool:
        """Whether another sensor answers than the configured one, also one that the head can read."""
        known = self._status.imu_status in (ImuStatus.WRONG_ID, ImuStatus.RUNNING)
        return known and self._status.who_am_i not in self._sensor.kind.identities

    def _check_sensor(self) -> None:
        """Raise the sensor's error, after the head had time to set it up again."""
        if self._another_sensor or (
            self._status.imu_status != ImuStatus.RUNNING
            and seconds_between(self._sensor_lost_ns, self._clock.now_ns()) > max(RECOVERY_S, self._sensor.start_s)
        ):
            raise self._sensor_error()

    def _sensor_error(self) -> RigError:
        status, sensor, head = self._status, self._sensor, f"the rig head at {self._link.name}"
        place = f"I2C address {sensor.setup.address:#04x} of {head}"
        evidence = {"imu_status": status.imu_status.name.lower()}
        match status.imu_status:
            case _ if self._another_sensor:
                return another_sensor(sensor.kind, status.who_am_i, sensor.setup.address, head)
            case ImuStatus.BUS_STUCK:
                return DeviceSilent(
                    f"The I2C bus of {head} is stuck: SDA or SCL is held low.",
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

    def _fresh_sample(self) -> Sample:
        """Return a sample that is at most a tenth of a second and a few periods old."""
        start_ns = self._clock.now_ns()
        oldest_s = 0.1 + 5 / self.rate_hz
        while True:
            with self._in_use():
                self._check_sensor()
                sample, now_ns = self._stream.newest, self._clock.now_ns()
                if sample is not None and seconds_between(self._stream.newest_ns, now_ns) <= oldest_s:
                    return sample
                if seconds_between(start_ns, now_ns) > RECOVERY_S:
                    raise self._sensor_error()
            self._clock.sleep(0.005)


def open_head(config: RigConfig, open_port: Callable[[], SerialConnection], clock: Clock) -> RigHead:
    """Open the head at ``config.head.port``; its outputs stay off.

    ``open_port`` opens its port, also again after the cable was unplugged.

    Raises ConfigError, DeviceNotFound, FirmwareMismatch, DeviceMismatch, DeviceSilent: see `RigHead`.
    """
    sensor, head = head_sensor(config.imu), config.head
    return RigHead(open_port(), clock, sensor, deadman_s=head.deadman_s, name=head.port, reopen=open_port)


@contextmanager
def powered(config: RigConfig, open_port: Callable[[], SerialConnection], clock: Clock) -> Iterator[None]:
    """Power the servo for the duration of a ``with`` block if its supply goes through a rig head.

    Raises `EmergencyStop`, `HeartbeatLost`, `HeadRestarted`: the head keeps the supply off until the fault is
    acknowledged. `DeviceNotFound`, `FirmwareMismatch`, `DeviceMismatch`, `DeviceSilent`: see `RigHead`.
    """
    if not (config.imu.connection == "head" and config.head.power):
        yield
        return
    head = open_head(config, open_port, clock)
    try:
        head.check()
        head.set_power(True)
        clock.sleep(POWER_UP_S)
        yield
    finally:
        head.close()
