"""Opens the configured rig head, and switches on its outputs."""

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

    ``open_port`` opens its port, also again after the cable was unplugged.

    Raises ConfigError, DeviceNotFound, FirmwareMismatch, DeviceMismatch, DeviceSilent: see `RigHead`.
    """
    imu = config.imu
    sensor = head_sensor(
        imu.model, address=imu.address, range_dps=imu.range_dps, rate_hz=imu.rate_hz, bandwidth_hz=imu.bandwidth_hz
    )
    connection = open_port()
    try:
        return RigHead(
            connection, clock, sensor, deadman_s=config.head.deadman_s, name=config.head.port, reopen=open_port
        )
    except BaseException:
        connection.close()
        raise


@contextmanager
def powered(config: RigConfig, open_port: Callable[[], SerialConnection], clock: Clock) -> Iterator[None]:
    """Power the servo for the duration of a ``with`` block if its supply goes through a rig head.

    Raises
    ------
    EmergencyStop, HeartbeatLost, HeadRestarted
        The head keeps the supply off until the fault is acknowledged.
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
    """Switch on the servo's power and the ring light if they are connected; return the fault that was latched.

    A fault of an earlier program is cleared on the head and returned. The caller latches it, so that the operator must
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
