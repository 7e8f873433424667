"""The AX-12A and its Protocol 1.0, driven by the unmodified SDK."""

import pytest
from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, GroupSyncWrite, Protocol1PacketHandler
from hypothesis import given
from hypothesis import strategies as st

from rig.devices.dynamixel.port import ClockedPort
from rig.devices.dynamixel.registers import control_table
from sim.noise import NoiseModel
from sim.servo import Ax12Servo, ServoBus, SimSerial, XSeriesServo
from sim.servo.ax12 import BAUD_RATES, DEG_PER_COUNT, DPS_PER_UNIT, ENTRIES
from sim.servo.base import BOOT_S
from sim.servo.motor import OVERLOAD_S
from sim.servo.protocol1 import Error, PacketParser1, checksum, status_packet1
from sim.servo.protocol2 import InstructionPacket, StatusPacket
from sim.world import World
from tests.fuzzing import examples

quick = examples(17)
GOAL, SPEED, POSITION, VOLTAGE = 30, 32, 36, 42


class Line1:
    """One AX-12A with id 1 at 1 MBd on a perfect bench, and the SDK."""

    def __init__(self) -> None:
        self.world = World(noise=NoiseModel.none())
        self.bus = ServoBus(self.world.clock)
        self.servo = Ax12Servo(self.world)
        self.bus.attach(self.servo)
        self.frames: list[bytes] = []
        self.bus.taps.append(lambda frame: self.frames.append(frame.data))
        self.port = ClockedPort(SimSerial(self.bus, 1_000_000, timeout=0.002), self.world.clock)
        self.sdk = Protocol1PacketHandler()

    def read(self, address: int, size: int = 2) -> int:
        data, result, error = self.sdk.readTxRx(self.port, 1, address, size)
        assert (result, error) == (COMM_SUCCESS, 0)
        return int.from_bytes(bytes(data), "little")

    def write(self, address: int, value: int, size: int = 2) -> int:
        result, error = self.sdk.writeTxRx(self.port, 1, address, size, list(value.to_bytes(size, "little")))
        assert result == COMM_SUCCESS
        return int(error)

    def sleep(self, seconds: float) -> None:
        self.world.clock.sleep(seconds)


@pytest.fixture
def line() -> Line1:
    return Line1()


# -- packets -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "packet"),
    [
        ("FF FF 01 02 01 FB", InstructionPacket(1, 1, b"")),
        ("FF FF 01 04 02 2B 01 CC", InstructionPacket(1, 2, b"\x2b\x01")),
        ("FF FF FE 04 03 03 01 F6", InstructionPacket(0xFE, 3, b"\x03\x01")),
    ],
)
def test_emanual_instruction_packets_are_understood(frame: str, packet: InstructionPacket) -> None:
    assert PacketParser1().feed(bytes.fromhex(frame)) == [packet]


def test_status_packets_equal_the_emanuals() -> None:
    assert status_packet1(1, StatusPacket(0, b"\x20")) == bytes.fromhex("FF FF 01 03 00 20 DB")
    assert status_packet1(1, StatusPacket(0)) == bytes.fromhex("FF FF 01 02 00 FC")


@quick
@given(
    sent=st.lists(st.tuples(st.integers(0, 252), st.integers(1, 6), st.binary(max_size=20)), max_size=5),
    cuts=st.lists(st.integers(0, 200), max_size=6),
)
def test_packets_are_found_in_any_pieces(sent: list[tuple[int, int, bytes]], cuts: list[int]) -> None:
    stream = b""
    for bus_id, instruction, parameters in sent:
        body = bytes((bus_id, len(parameters) + 2, instruction)) + parameters
        stream += b"\xff\xff" + body + bytes((checksum(body),))
    parser, found, start = PacketParser1(), [], 0
    for cut in [*sorted(cuts), len(stream)]:
        found += parser.feed(stream[start:cut])
        start = max(start, cut)
    assert [(p.bus_id, p.instruction, p.parameters) for p in found] == sent


@quick
@given(parameters=st.binary(max_size=20), data=st.data())
def test_flipped_bit_is_never_accepted(parameters: bytes, data: st.DataObject) -> None:
    body = bytes((1, len(parameters) + 2, 3)) + parameters
    frame = bytearray(b"\xff\xff" + body + bytes((checksum(body),)))
    bit = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[bit // 8] ^= 1 << bit % 8
    assert bytes(body[3:]) not in [
        p.parameters for p in PacketParser1().feed(bytes(frame)) if p.intact and p.parameters
    ]


# -- the servo ---------------------------------------------------------------------------------------------------------


def test_control_tables_of_driver_and_servo_are_equal() -> None:
    """The two tables were written independently."""
    assert {n: (r.address, r.size) for n, r in control_table("ax_12a").items()} == {
        n: (e.address, e.size) for n, e in ENTRIES.items()
    }


def test_only_the_ax12_answers_protocol_1(line: Line1) -> None:
    assert line.sdk.ping(line.port, 1) == (12, COMM_SUCCESS, 0)
    assert line.read(0) == 12
    assert line.sdk.ping(line.port, 2)[1] == COMM_RX_TIMEOUT
    x = XSeriesServo(World(clock=line.world.clock), bus_id=1, baudrate=1_000_000)
    line.bus.attach(x)
    assert line.sdk.ping(line.port, 1) == (12, COMM_SUCCESS, 0)
    assert len([frame for frame in line.frames if frame[:3] == b"\xff\xff\xfd"]) == 0


@pytest.mark.parametrize("goal", [0, 200, 512, 1023])
def test_goal_enables_torque_and_is_reached_within_300_degrees(line: Line1, goal: int) -> None:
    assert line.read(POSITION) == 512
    assert line.write(GOAL, goal) == 0
    assert line.read(24, 1) == 1
    line.sleep(2.0)
    assert line.read(POSITION) == goal
    assert line.read(46, 1) == 0
    assert line.world.shaft()[0] == pytest.approx((goal - 512) * DEG_PER_COUNT)


def test_speed_limits_the_motion_and_carries_its_direction(line: Line1) -> None:
    line.write(SPEED, 100)
    line.write(GOAL, 1023)
    line.sleep(1.0)
    assert line.read(38) == 100
    assert line.read(46, 1) == 1
    assert line.world.shaft()[1] == pytest.approx(100 * DPS_PER_UNIT)
    line.write(GOAL, 0)
    line.sleep(1.0)
    assert line.read(38) == 100 | 0x400


def test_goals_outside_the_angle_limits_are_rejected(line: Line1) -> None:
    assert line.write(6, 300) == 0
    assert line.write(GOAL, 299) == Error.ANGLE_LIMIT
    assert line.write(GOAL, 1024) == Error.RANGE
    assert line.write(POSITION, 5) == Error.RANGE
    assert line.read(24, 1) == 0


def test_wheel_mode_needs_both_limits_zero(line: Line1) -> None:
    line.write(8, 0)
    line.write(24, 1, 1)
    line.write(SPEED, 512)
    line.sleep(5.0)
    rotated = line.world.shaft()[0]
    assert rotated > 360
    assert line.read(POSITION) == 1023  # beyond its potentiometer
    line.write(SPEED, 512 | 0x400)
    line.sleep(5.0)
    assert line.world.shaft()[0] < rotated
    line.write(SPEED, 0)
    line.sleep(1.0)
    assert line.world.shaft()[1] == 0.0


def test_supply_out_of_range_shows_in_every_answer(line: Line1) -> None:
    line.servo.set_voltage(5.0)
    data, result, error = line.sdk.readTxRx(line.port, 1, VOLTAGE, 1)
    assert (result, error, data) == (COMM_SUCCESS, Error.VOLTAGE, [50])


def test_jam_ends_in_overload_and_a_torque_limit_of_zero(line: Line1) -> None:
    line.write(GOAL, 700)
    line.servo.jam()
    line.write(GOAL, 1000)
    line.sleep(OVERLOAD_S + 1.0)
    _, _, error = line.sdk.readTxRx(line.port, 1, 24, 1)
    assert error & Error.OVERLOAD
    assert line.servo.memory["Torque Enable"] == line.servo.memory["Torque Limit"] == 0
    line.servo.free()
    line.write(24, 1, 1)
    assert line.servo.memory["Torque Enable"] == 0  # until the limit is written again
    line.write(34, 1023)
    assert line.write(24, 1, 1) == 0
    assert line.servo.memory["Torque Enable"] == 1


def test_reg_write_waits_for_action(line: Line1) -> None:
    line.sdk.regWriteTxRx(line.port, 1, GOAL, 2, [0, 3])
    assert line.read(44, 1) == 1
    line.sleep(1.0)
    assert line.read(POSITION) == 512
    line.sdk.action(line.port, 1)
    line.sleep(2.0)
    assert line.read(POSITION) == 768


def test_sync_write_writes_other_values_to_each_servo(line: Line1) -> None:
    other = World(noise=NoiseModel.none(), clock=line.world.clock)
    line.bus.attach(Ax12Servo(other, bus_id=7))
    group = GroupSyncWrite(line.port, line.sdk, GOAL, 2)
    group.addParam(1, [100, 0])
    group.addParam(7, [0, 2])
    assert group.txPacket() == COMM_SUCCESS
    line.sleep(2.0)
    assert line.read(POSITION) == 100
    assert other.shaft()[0] == pytest.approx(0.0)


def test_servo_without_power_is_silent_and_loses_its_ram(line: Line1) -> None:
    line.write(SPEED, 100)
    line.servo.power_off()
    assert line.sdk.ping(line.port, 1)[1] == COMM_RX_TIMEOUT
    line.servo.power_on()
    line.sleep(BOOT_S)
    assert line.read(SPEED) == 0
    assert line.read(34) == 1023


@pytest.mark.parametrize(("option", "value"), [("bus_id", 254), ("baudrate", 4_500_000)])
def test_invalid_servos_are_rejected(option: str, value: int) -> None:
    with pytest.raises(ValueError, match=str(value)):
        Ax12Servo(World(), **{option: value})


@pytest.mark.parametrize("baud", sorted(BAUD_RATES.values()))
def test_servo_uses_the_baud_rate_in_its_register(baud: int) -> None:
    assert Ax12Servo(World(), baudrate=baud).baudrate == baud
