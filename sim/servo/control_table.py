"""The memory of a servo: its bytes, its registers, its EEPROM and its access rules."""

from collections.abc import Iterator

from rig.devices.dynamixel.registers import ControlTable, Register, control_table
from sim.servo.models import ServoModel
from sim.servo.protocol2 import StatusError

MOST_INDIRECT = 128  # e-manual, Indirect Address of the P series

_READ_ONLY = frozenset(
    {
        *("Model Number", "Model Information", "Firmware Version", "Registered Instruction", "Hardware Error Status"),
        *("Realtime Tick", "Moving", "Moving Status", "Velocity Trajectory", "Position Trajectory"),
        *("Present PWM", "Present Load", "Present Current", "Present Velocity", "Present Position"),
        *("Present Input Voltage", "Present Temperature"),
    }
)


class InstructionRejected(Exception):
    """The device rejects an instruction with an error."""

    def __init__(self, error: StatusError) -> None:
        super().__init__(error.name)
        self.error = error


class Memory:
    """Control table of a servo; values by register name, signed if the register is.

    A byte of Indirect Data is the byte at its Indirect Address. Addresses below `ram_start` are EEPROM: kept without
    power, locked while torque is on. From `live_start` (Realtime Tick) on, registers follow the world. `one_revolution`
    are the positions within one revolution.
    """

    def __init__(self, model: ServoModel, firmware: int) -> None:
        table = control_table(model.name, firmware)
        row = self.row = table.row
        self.ram_start, self.live_start = table.ram_start, table["Realtime Tick"].address
        lowest = row.zero_counts - row.counts_per_revolution // 2
        self.one_revolution = range(lowest, lowest + row.counts_per_revolution)
        self._ranges = {
            **model.ranges,
            "Min Position Limit": self.one_revolution,
            "Max Position Limit": self.one_revolution,
        }
        self._registers = {register.name: register for register in _plain(table)}
        self._indirect: dict[int, Register] = {}
        for first, data, count in _indirect_blocks(table):
            for i in range(count):
                pointer = Register(f"Indirect Address at {first + 2 * i}", first + 2 * i, 2, signed=False)
                self._registers[pointer.name] = pointer
                self._indirect[data + i] = pointer
                name = f"Indirect Data at {data + i}"
                self._registers[name] = Register(name, data + i, 1, signed=False)
        self._at = {register.address: register for register in self._registers.values()}
        self._size = max(register.address + register.size for register in self._registers.values())
        self._image = bytearray(self._size)
        last = self._registers["Present Temperature"]
        self._live_end = last.address + last.size
        identity = {"Firmware Version": firmware, "Model Number": row.number}
        limits = {"Min Position Limit": self.one_revolution[0], "Max Position Limit": self.one_revolution[-1]}
        self._defaults = {**limits, **model.initial, **identity}
        for address, pointer in self._indirect.items():
            self._defaults[pointer.name] = address
        self._restore(0, self._size)

    def __contains__(self, name: str) -> bool:
        return name in self._registers

    def __getitem__(self, name: str) -> int:
        register = self._registers[name]
        return register.decode(bytes(self._image[register.address : register.address + register.size]))

    def __setitem__(self, name: str, value: int) -> None:
        """Set a register without a check of access; OverflowError if the value does not fit."""
        register = self._registers[name]
        self._image[register.address : register.address + register.size] = register.encode(value)

    def live(self) -> bytes:
        """Return the registers that follow the world, as one block."""
        return bytes(self._image[self.live_start : self._live_end])

    def set_live(self, block: bytes) -> None:
        """Set the registers that follow the world, in the order of `live`."""
        self._image[self.live_start : self._live_end] = block

    @property
    def starts_with_torque(self) -> bool:
        """Whether the Startup Configuration enables torque at power-up; not all models have it."""
        return "Startup Configuration" in self._registers and self["Startup Configuration"] == 1

    def forget_ram(self) -> None:
        """Set the RAM area to its initial values, as at power-up."""
        self._restore(self.ram_start, self._size)

    def forget_all(self, keep: tuple[str, ...] = ()) -> None:
        """Set all registers except those named in ``keep`` to their initial values."""
        kept = {name: self[name] for name in keep}
        self._restore(0, self._size)
        for name, value in kept.items():
            self[name] = value

    def read(self, address: int, size: int) -> bytes:
        """Return ``size`` bytes from ``address``; addresses between the registers read as 0, as on the device.

        Raises `Rejection`: DATA_LENGTH for no bytes, ACCESS if the range exceeds the table.
        """
        if size == 0:
            raise InstructionRejected(StatusError.DATA_LENGTH)
        if address + size > self._size:
            raise InstructionRejected(StatusError.ACCESS)
        data = bytes(self._image[address : address + size])
        if address + size > self.ram_start and not self._indirect.keys().isdisjoint(range(address, address + size)):
            return bytes(self._image[self._resolve(a)] for a in range(address, address + size))
        return data

    def entries(self, address: int, data: bytes) -> list[tuple[Register, int]]:
        """Return the registers that a write of ``data`` to ``address`` sets, with values checked against their ranges.

        Raises `Rejection`: ACCESS for a read-only register or an address without a register, DATA_LENGTH for a part of
        a register, DATA_RANGE for a value outside its range.
        """
        if not data:
            raise InstructionRejected(StatusError.DATA_LENGTH)
        targets = [self._resolve(address + i) for i in range(len(data))]
        entries = []
        i = 0
        while i < len(data):
            register = self._at.get(targets[i])
            if register is None:
                raise InstructionRejected(
                    StatusError.DATA_LENGTH if self._within_register(targets[i]) else StatusError.ACCESS
                )
            if register.name in _READ_ONLY:
                raise InstructionRejected(StatusError.ACCESS)
            if targets[i : i + register.size] != list(range(register.address, register.address + register.size)):
                raise InstructionRejected(StatusError.DATA_LENGTH)
            value = register.decode(data[i : i + register.size])
            if not self._takes(register, value):
                raise InstructionRejected(StatusError.DATA_RANGE)
            entries.append((register, value))
            i += register.size
        return entries

    def _takes(self, register: Register, value: int) -> bool:
        if register.name.startswith("Indirect Address"):
            return self.ram_start <= value < self._size
        allowed = self._ranges.get(register.name)
        return allowed is None or value in allowed

    def _resolve(self, address: int) -> int:
        pointer = self._indirect.get(address)
        return address if pointer is None else self[pointer.name]

    def _within_register(self, address: int) -> bool:
        return any(a in self._at and a + self._at[a].size > address for a in range(address - 3, address))

    def _restore(self, start: int, end: int) -> None:
        for register in self._registers.values():
            if start <= register.address < end:
                self[register.name] = self._defaults.get(register.name, 0)


def _plain(table: ControlTable) -> Iterator[Register]:
    """Yield the registers that are not part of an indirect block."""
    return (register for register in table.values() if not register.name.startswith("Indirect"))


def _indirect_blocks(table: ControlTable) -> Iterator[tuple[int, int, int]]:
    """Yield (first Indirect Address, first Indirect Data, count) of each block.

    The addresses of a block end where its data begins. The table's entries "Write" and "Read" are a convention of the
    SDK's users for parts of blocks; only a "Read" beyond the first block's data is another block.
    """
    if "Indirect Address 1" not in table:
        return
    first, data = table["Indirect Address 1"].address, table["Indirect Data 1"].address
    count = min((data - first) // 2, MOST_INDIRECT)
    yield first, data, count
    second, second_data = table["Indirect Address Read"].address, table["Indirect Data Read"].address
    if second >= data + count:
        yield second, second_data, (second_data - second) // 2
