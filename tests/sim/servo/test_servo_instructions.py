"""Every instruction, sent by the unmodified SDK."""

import pytest
from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
)

from sim.servo import Sender
from sim.servo.models import MODELS
from sim.servo.protocol2 import StatusError, with_crc
from tests.sim.servo.servo_bench import Line


def word(value: int) -> list[int]:
    return [value & 0xFF, value >> 8 & 0xFF]


def double(value: int) -> list[int]:
    return list(value.to_bytes(4, "little", signed=True))


@pytest.fixture
def three(line: Line) -> Line:
    line.add(7, "xm430_w350")
    line.add(4, "xl330_m288")
    return line


# -- ping, read, write ---------------------------------------------------------------------------------------------


def test_bytes_on_the_wire_equal_the_emanuals_and_the_sdks(line: Line) -> None:
    assert line.sdk.ping(line.port, 1) == (1060, COMM_SUCCESS, 0)
    assert line.sent(Sender.HOST) == [bytes.fromhex("FFFFFD000103000119 4E".replace(" ", ""))]
    line.frames.clear()
    recorded = []
    write = line.port.writePort
    line.port.writePort = lambda packet: recorded.append(bytes(packet)) or write(packet)
    line.write("Goal Position", 512)
    assert recorded == line.sent(Sender.HOST) == [bytes.fromhex("FFFFFD00010900037400000200 00CA89".replace(" ", ""))]


@pytest.mark.parametrize(
    ("model", "number"),
    [("xl430_w250", 1060), ("xm430_w350", 1020), ("xl330_m288", 1200), ("mx_28", 30), ("ph54_200_s500", 2020)],
)
def test_every_model_answers_with_its_number_and_initial_values(model: str, number: int) -> None:
    line = Line()
    servo = line.add(1, model)
    assert line.sdk.ping(line.port, 1)[0] == number
    assert line.read("Firmware Version") == MODELS[model].firmware
    for name, value in servo.model.initial.items():
        if name not in ("Baud Rate", "Secondary ID") and name in line.table(1):
            assert line.read(name) == value, name
    assert line.read("Present Input Voltage") == round(servo.model.supply_v * 10)
    assert line.read("Hardware Error Status") == 0


def test_broadcast_ping_finds_all_servos_in_order_of_id(three: Line) -> None:
    found, result = three.sdk.broadcastPing(three.port)
    assert result == COMM_SUCCESS
    assert found == {1: [1060, 46], 4: [1200, 52], 7: [1020, 46]}
    assert [data[4] for data in three.sent(Sender.DEVICE)] == [1, 4, 7]


@pytest.mark.parametrize(
    ("address", "data", "error"),
    [
        (132, [0, 0, 0, 0], StatusError.ACCESS),  # Present Position is read only
        (0, [0, 0], StatusError.ACCESS),  # Model Number is
        (66, [0], StatusError.ACCESS),  # nothing is there
        (660, [0] * 4, StatusError.ACCESS),  # beyond the end
        (116, [0, 0], StatusError.DATA_LENGTH),  # half a Goal Position
        (118, [0, 0], StatusError.DATA_LENGTH),  # its other half
        (64, [2], StatusError.DATA_RANGE),
        (7, [253], StatusError.DATA_RANGE),
        (11, [16], StatusError.DATA_RANGE),  # PWM control is not emulated
        (98, [128], StatusError.DATA_RANGE),
        (116, double(4096), StatusError.DATA_LIMIT),  # Max Position Limit in position mode
        (104, double(266), StatusError.DATA_LIMIT),  # Velocity Limit
        (104, double(-266), StatusError.DATA_LIMIT),
        (100, word(886), StatusError.DATA_LIMIT),  # PWM Limit
    ],
)
def test_invalid_writes_return_the_error_of_the_emanual(line: Line, address: int, data: list[int], error: int) -> None:
    before = bytes(line.servos[1].memory.read(0, 635))
    assert line.sdk.writeTxRx(line.port, 1, address, len(data), data) == (COMM_SUCCESS, error)
    assert line.servos[1].memory.read(0, 635) == before


def test_reads_beyond_the_table_and_unknown_instructions_are_rejected(line: Line) -> None:
    _, result, error = line.sdk.readTxRx(line.port, 1, 650, 20)
    assert (result, error) == (COMM_SUCCESS, StatusError.ACCESS)
    line.serial.write(with_crc(bytes.fromhex("FFFFFD0001030077")))
    line.sleep(0.01)
    assert line.serial.read(11)[8] == StatusError.INSTRUCTION


def test_damaged_instruction_is_answered_with_a_crc_error_and_not_executed(line: Line) -> None:
    frame = bytearray(with_crc(bytes.fromhex("FFFFFD000106000341 0001".replace(" ", ""))))  # LED = 1
    frame[-1] ^= 0x40
    line.serial.write(frame)
    line.sleep(0.01)
    assert line.serial.read(11)[8] == StatusError.CRC
    assert line.read("LED") == 0


# -- registered and group instructions -----------------------------------------------------------------------------


@pytest.mark.parametrize(("level", "read", "write"), [(0, False, False), (1, True, False), (2, True, True)])
def test_status_return_level_selects_the_answered_instructions(line: Line, level: int, read: bool, write: bool) -> None:
    line.put(Status_Return_Level=level)
    assert line.sdk.ping(line.port, 1)[1] == COMM_SUCCESS
    assert (line.sdk.read1ByteTxRx(line.port, 1, 65)[1] == COMM_SUCCESS) is read
    assert (line.sdk.write1ByteTxRx(line.port, 1, 65, 1)[0] == COMM_SUCCESS) is write
    assert line.servos[1].memory["LED"] == 1


def test_new_id_and_baud_rate_are_used_from_the_next_instruction(line: Line) -> None:
    assert line.write("ID", 9) == 0  # answered under the old id, else the SDK would find no answer
    assert line.sdk.ping(line.port, 9) == (1060, COMM_SUCCESS, 0)
    assert line.sdk.ping(line.port, 1)[1] == COMM_RX_TIMEOUT
    line.servos[9] = line.servos[1]
    assert line.write("Baud Rate", 2, 9) == 0
    assert line.sdk.ping(line.port, 9)[1] == COMM_RX_TIMEOUT
    line.serial.baudrate = 115_200
    assert line.sdk.ping(line.port, 9)[1] == COMM_SUCCESS
