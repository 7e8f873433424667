"""The rig head: an IMU with a clock of its own, the light, the camera's trigger, the e-stop and the servo's power.

Its samples arrive by themselves, dated by its clock; a heartbeat beside the program keeps its outputs on, and compares
the clocks. When the program dies, the heartbeat ends and the head makes the bench safe by itself.
"""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import hypot, sqrt
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.clock import Clock, seconds_between
from rig.core.errors import (
    ConfigError,
    DeviceFault,
    DeviceMismatch,
    DeviceNotFound,
    DeviceSilent,
    DeviceUnplugged,
    EmergencyStop,
    FirmwareMismatch,
    HeadRestarted,
    HeartbeatLost,
    RequestRejected,
    RigError,
)
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head.link import HeadLink
from rig.devices.head.protocol import (
    BAUD,
    DEADMAN_MAX_MS,
    DEADMAN_MIN_MS,
    FIRMWARE,
    PROTOCOL_VERSION,
    SERIAL_UNSET,
    Acknowledge,
    Board,
    Counters,
    Done,
    HeadFault,
    HeadState,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Identity,
    ImuStatus,
    Input,
    Light,
    ReadCounters,
    Rejection,
    Relay,
    Reset,
    Sample,
    SampleFlag,
    Shutdown,
    StatusChanged,
    Stream,
    Trigger,
    Triggered,
)
from rig.devices.head.sensors import HeadSensor
from rig.devices.head.timing import HeadClock
from rig.devices.imu import ImuIdentity, ImuSamples

GREETING_S = 3.0
"""How long the first answer may take: opening its port restarts an Arduino, whose boot loader then waits."""
BEATS_A_DEADMAN = 4
FIRST_BEATS = 8
"""Beats before the first sample is dated."""
MEMORY_S = 2.0
"""How many samples wait for a reader; older ones are lost."""
RECOVERY_S = 0.5
"""How long the head may take to get a sensor back before that counts as silence."""

_RESTARTS = {
    Reset.UNKNOWN: "for an unknown reason",
    Reset.POWER_ON: "because its supply was off",
    Reset.EXTERNAL: "because it was reset (its button, or its port was opened)",
    Reset.BROWN_OUT: "because its supply broke down (brown-out)",
    Reset.WATCHDOG: "because its program hung (watchdog)",
}


@dataclass(frozen=True, slots=True)
class HeadIdentity(ImuIdentity):
    """The sensor, and the head that it hangs on; ``serial`` is None where the board was given no number."""

    board: str
    firmware: str
    protocol: int
    serial: int | None


@dataclass(frozen=True, slots=True)
class HeadStatus:
    """What the head last told of itself."""

    state: HeadState
    faults: HeadFault
    estop_open: bool
    relay_closed: bool
    imu_status: ImuStatus
    who_am_i: int


@dataclass(slots=True)
class HeadStatistics:
    """Counts since the head was opened.

    ``lost`` are samples that never reached a reader; ``dropped`` those among them that the head had no room to send.
    """

    lost: int = 0
    dropped: int = 0
    reconnects: int = 0
    restarts: int = 0


class RigHead:
    """An open rig head; a `rig.devices.imu.Imu`.

    Opening it says hello, compares the clocks, sets the sensor up and begins to stream. Outputs stay off.

    Parameters
    ----------
    wire
        The open port, at `protocol.BAUD`.
    clock
        The bench's clock.
    sensor
        What hangs on the head's I2C bus, and how it is to be set.
    deadman_s
        The silence after which the head makes the bench safe.
    name
        Of the port, for messages.
    reopen
        Opens the port anew after the cable was pulled.

    Raises
    ------
    DeviceNotFound
        Nobody answers who speaks the protocol.
    FirmwareMismatch
        The head speaks another version; the message says which side to update.
    DeviceSilent, DeviceMismatch
        The sensor on the head does not answer, or is another one.
    ConfigError
        ``deadman_s`` is none that the head allows.
    """

    def __init__(
        self,
        wire: SerialConnection,
        clock: Clock,
        sensor: HeadSensor,
        *,
        deadman_s: float = 0.25,
        name: str = "head",
        reopen: Callable[[], SerialConnection] | None = None,
    ) -> None:
        self._deadman_ms = round(1000 * deadman_s)
        if not DEADMAN_MIN_MS <= self._deadman_ms <= DEADMAN_MAX_MS:
            raise ConfigError(
                f"a deadman of {deadman_s:g} s is not possible",
                next_step=f"Set head.deadman_s to {DEADMAN_MIN_MS / 1000:g} to {DEADMAN_MAX_MS / 1000:g}.",
            )
        self._clock = clock
        self._sensor = sensor
        self._reopen = reopen
        self._lock = Lock()
        self._samples: deque[tuple[int, Sample]] = deque(maxlen=round(MEMORY_S * sensor.rate_hz))
        self._lost = 0
        self._next_index: int | None = None
        self._sample_us: int | None = None
        self._newest: Sample | None = None
        self._newest_ns = self._troubled_ns = self._beaten_ns = clock.now_ns()
        self._status = HeadStatus(HeadState.IDLE, HeadFault(0), False, False, ImuStatus.OFF, 0)
        self._restarted: Reset | None = None
        self._set_up = self._down = self._closed = False
        self.statistics = HeadStatistics()
        self._link = HeadLink(wire, clock, self._on_event, name)
        self._timing = HeadClock(2 * self._link.frame_ns(HeartbeatReply.LAYOUT.size))
        self._cancel: Callable[[], None] = lambda: None
        try:
            self._who = self._greet()
            self._begin()
            self._wait_until_running()
        except BaseException:
            self.close()
            raise
        self._cancel = clock.every(deadman_s / BEATS_A_DEADMAN, self._beside)

    # -- an Imu -----------------------------------------------------------------------------------------------------

    @property
    def identity(self) -> HeadIdentity:
        who, sensor, boards = self._who, self._sensor, {board.value: board.name.lower() for board in Board}
        return HeadIdentity(
            model=sensor.name,
            bus_address=sensor.setup.address,
            who_am_i=self._status.who_am_i,
            gyro_noise_dps_rthz=sensor.noise_dps_rthz,
            board=boards.get(who.board, f"unknown ({who.board})"),
            firmware=_version(who),
            protocol=who.protocol,
            serial=None if who.serial == SERIAL_UNSET else who.serial,
        )

    @property
    def rate_hz(self) -> float:
        return self._sensor.rate_hz

    @property
    def range_dps(self) -> float:
        return self._sensor.range_dps

    def read_samples(self) -> ImuSamples:
        """Return the samples that arrived since the last call, at most those of `MEMORY_S`.

        Raises
        ------
        DeviceSilent
            The head does not answer and cannot be reached anew, or it has lost its sensor.
        DeviceMismatch
            Another head, or another sensor, answers than the one that was opened.
        """
        with self._alone():
            self._go_on()
            self._heed_sensor()
            return self._collect()

    def read_gravity_g(self) -> NDArray[np.float64]:
        """Return the newest accelerometer reading (3,), in g; raises as `read_samples` does."""
        sample = self._fresh()
        return np.array([sample.accel_x, sample.accel_y, sample.accel_z]) / self._sensor.lsb_per_g

    def temperature_c(self) -> float:
        """Return the temperature of the sensor's die; raises as `read_samples` does."""
        return self._sensor.temperature_c(self._fresh().temperature)

    def close(self) -> None:
        """Leave in peace: outputs off, no deadman; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._cancel()
        with self._lock:
            if not self._down:
                with suppress(RigError):  # the head finds out by itself that nobody beats any more
                    self._link.request(Shutdown(), Done)
            with suppress(OSError):
                self._link.close()

    # -- light, trigger, power, e-stop ------------------------------------------------------------------------------

    @property
    def status(self) -> HeadStatus:
        """What the head last told; at most a quarter of the deadman old."""
        return self._status

    @property
    def fault(self) -> RigError | None:
        """Why the head has made the bench safe, or None."""
        faults, evidence = self._status.faults, {"faults": self._status.faults.name, "port": self._link.name}
        if HeadFault.ESTOP in faults:
            return EmergencyStop(
                "The e-stop is pressed, or its loop is open: light and servo power are off.",
                next_step="Look at the bench, then release the e-stop or repair its cable.",
                evidence=evidence,
            ).ask_to_acknowledge()
        if self._restarted is not None or faults & (HeadFault.BROWN_OUT | HeadFault.WATCHDOG):
            cause = Reset(self._who.reset_cause) if self._restarted is None else self._restarted
            return HeadRestarted(
                f"The rig head at {self._link.name} restarted {_RESTARTS[cause]}: light and servo power went off.",
                next_step="Check its supply and USB cable.",
                evidence={**evidence, "reset_cause": cause.name.lower()},
            ).ask_to_acknowledge()
        if HeadFault.DEADMAN in faults:
            return HeartbeatLost(
                f"The rig head received nothing from this computer for {self._deadman_ms} ms: light and servo power "
                "are off.",
                next_step="Check whether a program was killed or a cable unplugged. If not, increase head.deadman_s.",
                evidence={**evidence, "deadman_ms": self._deadman_ms},
            ).ask_to_acknowledge()
        return None

    def check(self) -> None:
        """Raise what the head has made the bench safe for (`EmergencyStop`, `HeartbeatLost`, `HeadRestarted`)."""
        with self._alone():
            self._go_on()
        if fault := self.fault:
            raise fault

    def acknowledge(self) -> None:
        """Clear the latched faults, whose causes a person has seen; outputs stay off until they are asked for.

        Raises
        ------
        EmergencyStop
            The e-stop is still pressed.
        DeviceSilent
            The head does not answer.
        """
        with self._alone():
            self._go_on()
            try:
                self._link.request(Acknowledge(0xFF), Done)
            except RequestRejected as refused:
                if refused.evidence["refusal"] == Rejection.CAUSE_PERSISTS and (fault := self.fault):
                    raise fault from refused
                raise
            self._restarted = None
            self._beat()

    def set_light(self, level: float) -> None:
        """Set the ring light, 0 to 1; raises RequestRejected after a fault."""
        with self._alone():
            self._go_on()
            self._link.request(Light(round(255 * min(max(level, 0.0), 1.0))), Done)

    def set_power(self, on: bool) -> None:
        """Close or open the servo's power relay; raises RequestRejected where a fault is latched."""
        with self._alone():
            self._go_on()
            self._link.request(Relay(int(on)), Done)

    def trigger(self, width_s: float = 0.001) -> int:
        """Give the camera one pulse; return when it begins, on the bench's clock (ns)."""
        with self._alone():
            self._go_on()
            answer = self._link.request(Trigger(round(1e6 * width_s)), Triggered)
            time_ns, _ = self._timing.to_host(np.array([self._timing.unwrap(answer.time_us)]))
            return int(time_ns[0])

    # -- how it does ------------------------------------------------------------------------------------------------

    def counters(self) -> Counters:
        """Return the head's own counts since it started."""
        with self._alone():
            return self._link.request(ReadCounters(), Counters)

    def report(self) -> dict[str, Any]:
        """Return in words how the head does, for people and records."""
        status = self._status
        return {
            "state": status.state.name.lower(),
            "faults": [str(fault.name).lower() for fault in status.faults],
            "estop_open": status.estop_open,
            "relay_closed": status.relay_closed,
            "sensor": status.imu_status.name.lower(),
            "line": self.health(),
        }

    def health(self) -> dict[str, float]:
        """Return statistics of line, clock and samples, units in the names."""
        return {
            **self._link.counts(),
            **{name: getattr(self.statistics, name) for name in self.statistics.__dataclass_fields__},
            "drift_ppm": round(self._timing.drift_ppm, 1),
            "time_uncertainty_us": round(self._timing.uncertainty_ns / 1000, 1),
        }

    # -- opening ----------------------------------------------------------------------------------------------------

    def _greet(self) -> Identity:
        """Return who answers, once it speaks our protocol."""
        start_ns = self._clock.now_ns()
        while True:
            try:
                self._link.start()
                who = self._link.request(Hello(PROTOCOL_VERSION), Identity, attempts=1)
                break
            except DeviceSilent as silent:
                if isinstance(silent, DeviceUnplugged):
                    raise
                if seconds_between(start_ns, self._clock.now_ns()) > GREETING_S:
                    raise DeviceNotFound(
                        f"no rig head answers at {self._link.name}",
                        next_step=f"Check that head.port is the head's, and flash it: make -C firmware flash "
                        f"PORT={self._link.name}.",
                        evidence={"baud": BAUD, **self._link.counts()},
                    ) from silent
        if who.protocol != PROTOCOL_VERSION:
            ours = ".".join(map(str, FIRMWARE))
            older = who.protocol < PROTOCOL_VERSION
            raise FirmwareMismatch(
                f"the rig head at {self._link.name} (firmware {_version(who)}) speaks protocol {who.protocol}, this "
                f"program {PROTOCOL_VERSION}",
                next_step=f"Flash the head with firmware {ours}: make -C firmware flash PORT={self._link.name}."
                if older
                else "Update this program: the head's firmware is newer.",
                evidence={"head": who.protocol, "program": PROTOCOL_VERSION, "firmware": _version(who)},
            )
        return who

    def _begin(self) -> None:
        """Compare the clocks, set the sensor up and let it stream."""
        self._miss(len(self._samples))
        self._samples.clear()  # dated by a clock that is no more
        self._timing.restart()
        self._link.restarted()
        self._next_index = None
        for _ in range(FIRST_BEATS):
            self._beat()
        self._link.request(self._sensor.setup, Done)
        self._link.request(Stream(1), Done)
        self._troubled_ns = self._clock.now_ns()
        self._set_up = True

    def _wait_until_running(self) -> None:
        deadline_ns = self._clock.now_ns() + round(self._sensor.start_s * 1e9)
        while self._newest is None:
            self._pump()
            if self._clock.now_ns() > deadline_ns or self._status.imu_status == ImuStatus.WRONG_ID:
                self._beat()
                raise self._sensor_trouble()
            self._clock.sleep(0.005)

    def _sensor_trouble(self) -> RigError:
        sensor, status = self._sensor, self._status
        at = f"I2C address {sensor.setup.address:#04x} of the rig head at {self._link.name}"
        evidence = {"imu_status": status.imu_status.name.lower()}
        match status.imu_status:
            case ImuStatus.WRONG_ID:
                likely = sensor.others.get(status.who_am_i, "another chip")
                return DeviceMismatch(
                    f"WHO_AM_I at {at} is {status.who_am_i:#04x}, expected {sensor.who_am_i:#04x} ({sensor.name}): "
                    f"probably {likely}",
                    next_step="Check the wiring, and head.sensor and imu.address.",
                    evidence={"got": status.who_am_i, "expected": sensor.who_am_i},
                )
            case ImuStatus.BUS_STUCK:
                return DeviceSilent(
                    f"the I2C bus of the rig head at {self._link.name} is stuck: a line is held low",
                    next_step="Check SDA and SCL for a short, then switch the sensor's supply off and on.",
                    evidence=evidence,
                )
            case ImuStatus.SETTINGS_LOST:
                return DeviceFault(
                    f"the {sensor.name} at {at} does not keep its settings: its supply is interrupted",
                    next_step="Check its supply and cable, then open the bench again.",
                    evidence=evidence,
                )
            case _:
                return DeviceSilent(
                    f"the {sensor.name} at {at} does not answer",
                    next_step="Check the sensor's plug, supply, SDA and SCL, and its address (imu.address).",
                    evidence=evidence,
                )

    # -- going on ---------------------------------------------------------------------------------------------------

    @contextmanager
    def _alone(self) -> Iterator[None]:
        with self._lock:
            yield

    def _beside(self) -> None:
        """Heartbeat, and take what has arrived, unless the program is doing so."""
        if self._lock.acquire(blocking=False):
            try:
                if not self._down and not self._closed:
                    self._pump()
            except RigError:
                pass  # whoever uses the head next meets it too, and can tell
            finally:
                self._lock.release()

    def _go_on(self) -> None:
        """Take what has arrived; after a broken connection, connect anew."""
        if self._down:
            self._reconnect()
        self._pump()

    def _heed_sensor(self) -> None:
        """Raise what is wrong with the sensor, once the head has had its time to get it back."""
        if self._status.imu_status == ImuStatus.WRONG_ID or (
            self._status.imu_status != ImuStatus.RUNNING
            and seconds_between(self._troubled_ns, self._clock.now_ns()) > max(RECOVERY_S, self._sensor.start_s)
        ):
            raise self._sensor_trouble()

    def _pump(self) -> None:
        try:
            self._link.poll()
            if self._restarted is not None and not self._set_up:
                self._who = self._link.request(Hello(PROTOCOL_VERSION), Identity)
                self._restarted = Reset(self._who.reset_cause)
                self._begin()
            if seconds_between(self._beaten_ns, self._clock.now_ns()) * BEATS_A_DEADMAN * 1000 >= self._deadman_ms:
                self._beat()
        except DeviceSilent:
            self._down = True
            raise

    def _beat(self) -> None:
        """Heartbeat until it is answered; a repetition is a beat of its own, whose times hold."""
        for last in (False, False, True):
            try:
                pulse = self._link.request(Heartbeat(self._deadman_ms), HeartbeatReply, attempts=1)
                break
            except DeviceSilent as silent:
                if last or isinstance(silent, DeviceUnplugged):
                    raise
        self._beaten_ns = self._link.heard_ns
        restarted = self._take_status(pulse)
        if not restarted:
            received_us = self._timing.unwrap(pulse.received_us)
            answered_us = self._timing.unwrap(pulse.sent_us)
            self._timing.add(self._link.sent_ns, received_us, answered_us, self._link.heard_ns)

    def _reconnect(self) -> None:
        """Open the port anew, and go on only with the head that was there before.

        Raises
        ------
        DeviceSilent
            The port is still gone, or nobody answers.
        DeviceMismatch
            Another head answers.
        """
        if self._reopen is None or self._closed:
            raise DeviceSilent(
                f"the rig head at {self._link.name} stopped answering",
                next_step="Check its USB cable, then open the bench again.",
                evidence=self._link.counts(),
            )
        with suppress(OSError):
            self._link.close()
        try:
            self._link.replace(self._reopen())
            who = self._greet()
        except DeviceNotFound as gone:
            raise DeviceSilent(gone.what, next_step=gone.next_step, evidence=gone.evidence) from gone
        same = ("board", "serial", "protocol", "major", "minor", "patch")
        pairs = {name: (getattr(who, name), getattr(self._who, name)) for name in same}
        if changed := {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}:
            raise DeviceMismatch(
                f"another rig head answers at {self._link.name} than before",
                next_step="Plug the bench's own head in, or open the bench again.",
                evidence={name: {"got": got, "expected": expected} for name, (got, expected) in changed.items()},
            )
        self._who = who
        self.statistics.reconnects += 1
        self._begin()
        self._down = False

    # -- what arrives -----------------------------------------------------------------------------------------------

    def _on_event(self, event: Sample | StatusChanged) -> None:
        if isinstance(event, StatusChanged):
            self._take_status(event)
        elif self._timing.known and self._set_up:
            self._take_sample(event)

    def _take_status(self, told: HeartbeatReply | StatusChanged) -> bool:
        """Remember what the head tells; return whether it has restarted, and so forgotten its sensor."""
        try:
            status = self._read_status(told)
        except ValueError:
            return False  # no head of this protocol tells such a thing
        before, self._status = self._status.imu_status, status
        if before == ImuStatus.RUNNING != status.imu_status:
            self._troubled_ns = self._clock.now_ns()
        restarted = self._set_up and status.imu_status == ImuStatus.OFF
        if restarted:
            self._set_up = False
            self._restarted = Reset(told.reset_cause) if isinstance(told, StatusChanged) else Reset.UNKNOWN
            self.statistics.restarts += 1
        return restarted

    @staticmethod
    def _read_status(told: HeartbeatReply | StatusChanged) -> HeadStatus:
        return HeadStatus(
            state=HeadState(told.state),
            faults=HeadFault(told.faults),
            estop_open=bool(told.inputs & Input.ESTOP_OPEN),
            relay_closed=bool(told.inputs & Input.RELAY_CLOSED),
            imu_status=ImuStatus(told.imu_status),
            who_am_i=told.who_am_i,
        )

    def _take_sample(self, sample: Sample) -> None:
        time_us = self._timing.unwrap(sample.time_us)
        if self._next_index is not None:
            self._miss((sample.index - self._next_index) % (1 << 16))
        elif self._newest is not None:  # the first one after a restart of the head, or of the connection
            gap_s = seconds_between(self._newest_ns, self._clock.now_ns())
            self._miss(max(round(gap_s * self.rate_hz) - 1, 1))
        if len(self._samples) == self._samples.maxlen:
            self._miss(1)
        self._samples.append((time_us, sample))
        if self._newest is not None and self._next_index is not None:
            self.statistics.dropped += (sample.dropped - self._newest.dropped) % 256
        self._next_index = (sample.index + 1) % (1 << 16)
        self._newest, self._newest_ns = sample, self._clock.now_ns()

    def _miss(self, count: int) -> None:
        self._lost += count
        self.statistics.lost += count

    def _collect(self) -> ImuSamples:
        taken = list(self._samples)
        self._samples.clear()
        lost, self._lost = self._lost, 0
        time_ns, sigma_ns = self._timing.to_host(np.array([time_us for time_us, _ in taken], np.int64))
        gyro = np.array([(s.gyro_x, s.gyro_y, s.gyro_z) for _, s in taken], float).reshape(-1, 3)
        if not all(s.flags & SampleFlag.EDGE for _, s in taken):
            sigma_ns = hypot(sigma_ns, 1e9 / self.rate_hz / sqrt(12))  # polled: anywhere within a period
        return ImuSamples(time_ns, gyro / self._sensor.lsb_per_dps, lost, round(sigma_ns))

    def _fresh(self) -> Sample:
        """Return a sample that is not older than a tenth of a second and a few periods."""
        start_ns = self._clock.now_ns()
        oldest_s = 0.1 + 5 / self.rate_hz
        while True:
            with self._alone():
                self._go_on()
                self._heed_sensor()
                sample, now_ns = self._newest, self._clock.now_ns()
                if sample is not None and seconds_between(self._newest_ns, now_ns) <= oldest_s:
                    return sample
                if seconds_between(start_ns, now_ns) > RECOVERY_S:
                    raise self._sensor_trouble()
            self._clock.sleep(0.005)


def _version(who: Identity) -> str:
    return f"{who.major}.{who.minor}.{who.patch}"
