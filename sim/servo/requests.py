"""The parameters of instructions to several devices, by device id in the order of the packet.

Source: e-manual "DYNAMIXEL Protocol 2.0", Sync Read, Sync Write, Bulk Read, Bulk Write and the fast variants.
"""

from sim.servo.protocol2 import Instruction, InstructionPacket

CHAINED_READS = frozenset(
    {Instruction.SYNC_READ, Instruction.FAST_SYNC_READ, Instruction.BULK_READ, Instruction.FAST_BULK_READ}
)
"""Instructions that devices answer one after the other."""
FAST_READS = frozenset({Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ})
"""Chained reads whose answers form one status packet."""


def word(data: bytes, start: int = 0) -> int:
    """Return the two bytes at ``start``, low byte first."""
    return data[start] | data[start + 1] << 8


def chained_reads(packet: InstructionPacket) -> dict[int, tuple[int, int]]:
    """Return address and size for each device; incomplete entries are left out."""
    parameters = packet.parameters
    if packet.instruction in (Instruction.BULK_READ, Instruction.FAST_BULK_READ):
        starts = range(0, len(parameters) - 4, 5)
        return {parameters[i]: (word(parameters, i + 1), word(parameters, i + 3)) for i in starts}
    if len(parameters) < 5:
        return {}
    return dict.fromkeys(parameters[4:], (word(parameters), word(parameters, 2)))


def group_writes(packet: InstructionPacket) -> dict[int, tuple[int, bytes]]:
    """Return address and data for each device; incomplete entries are left out."""
    parameters = packet.parameters
    writes = {}
    if packet.instruction == Instruction.SYNC_WRITE and len(parameters) > 4:
        address, size = word(parameters), word(parameters, 2)
        for i in range(4, len(parameters) - size, size + 1):
            writes[parameters[i]] = address, parameters[i + 1 : i + 1 + size]
    elif packet.instruction == Instruction.BULK_WRITE:
        i = 0
        while i + 5 <= len(parameters) and (end := i + 5 + word(parameters, i + 3)) <= len(parameters):
            writes[parameters[i]] = word(parameters, i + 1), parameters[i + 5 : end]
            i = end
    return writes
