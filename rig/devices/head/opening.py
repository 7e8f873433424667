"""Opens the rig head that the configuration describes, and switches on what it carries."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rig.config import HeadConfig, RigConfig
from rig.core.clock import Clock
from rig.core.errors import EmergencyStop, RigError
from rig.devices.dynamixel.port import SerialConnection
from rig.devices.head.head import RigHead
from rig.devices.head.sensors import head_sensor


def open_head(config: RigConfig, open_port: Callable[[], SerialConnection], clock: Clock) -> RigHead:
    """Open the head at ``config.head.port``; its outputs stay off.

    ``open_port`` opens its line, again where the cable was pulled meanwhile.

    Raises
    ------
    ConfigError, DeviceNotFound, FirmwareMismatch, DeviceMismatch, DeviceSilent
        See `RigHead`.
    """
    imu = config.imu
    sensor = head_sensor(
        imu.model,
        address=imu.address,
        range_dps=imu.range_dps,
        rate_hz=imu.rate_hz,
        bandwidth_hz=imu.bandwidth_hz,
    )
    wire = open_port()
    try:
        return RigHead(wire, clock, sensor, deadman_s=config.head.deadman_s, name=config.head.port, reopen=open_port)
    except BaseException:
        wire.close()
        raise


@contextmanager
def powered(config: RigConfig, open_port: Callable[[], SerialConnection], clock: Clock) -> Iterator[None]:
    """Feed the servo for the length of a ``with`` block, where its supply goes through a rig head.

    Raises
    ------
    EmergencyStop, HeartbeatLost, HeadRestarted
        The head keeps the supply open until that is acknowledged.
    DeviceNotFound, FirmwareMismatch, DeviceMismatch, DeviceSilent
        See `RigHead`.
    """
    if not (config.imu.connection == "head" and config.head.power):
        yield
        return
    head = open_head(config, open_port, clock)
    try:
        head.check()
        head.set_power(True)
        clock.sleep(config.head.power_up_s)
        yield
    finally:
        head.close()


def switch_on(head: RigHead, config: HeadConfig, clock: Clock) -> RigError | None:
    """Close the servo's power relay and light the ring, where they are wired; return the fault that was latched.

    A fault that the head kept from an earlier program is taken over: the caller latches it where a person must
    acknowledge it before anything moves.

    Raises
    ------
    EmergencyStop
        The e-stop is pressed, and the servo's supply goes through it.
    """
    fault = head.fault
    if fault is not None:
        try:
            head.acknowledge()
        except EmergencyStop:
            if config.power:
                raise
            return fault
    if config.power:
        head.set_power(True)
        clock.sleep(config.power_up_s)
    if config.light is not None:
        head.set_light(config.light)
    return fault
