"""The memory of a servo: its bytes, its registers, its EEPROM and its access rules."""

from rig.devices.dynamixel.registers import Register, control_table
from sim.servo.models import ServoModel
from sim.servo.protocol2 import StatusError

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

    Addresses below `ram_start` are EEPROM: kept without power, locked while torque is on. Indirect addressing is not
    simulated. From `live_start` (Realtime Tick) on, registers follow the world. `one_revolution`
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
        self._registers = {r.name: r for r in table.values() if not r.name.startswith("Indirect")}
        self._at = {register.address: register for register in self._registers.values()}
        self._size = max(register.address + register.size for register in table.values())
        self._image = bytearray(self._size)
        last = self._registers["Present Temperature"]
        self._live_end = last.address + last.size
        identity = {"Firmware Version": firmware, "Model Number": row.number}
        limits = {"Min Position Limit": self.one_revolution[0], "Max Position Limit": self.one_revolution[-1]}
        self._defaults = {**limits, **model.initial, **identity}
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

    def forget_ram(self) -> None:
        """Set the RAM area to its initial values, as at power-up."""
        self._restore(self.ram_start, self._size)

    def read(self, address: int, size: int) -> bytes:
        """Return ``size`` bytes from ``address``; addresses between the registers read as 0, as on the device.

        Raises `InstructionRejected`: DATA_LENGTH for no bytes, ACCESS if the range exceeds the table.
        """
        if size == 0:
            raise InstructionRejected(StatusError.DATA_LENGTH)
        if address + size > self._size:
            raise InstructionRejected(StatusError.ACCESS)
        return bytes(self._image[address : address + size])

    def entries(self, address: int, data: bytes) -> list[tuple[Register, int]]:
        """Return the registers that a write of ``data`` to ``address`` sets, with values checked against their ranges.

        Raises `InstructionRejected`: ACCESS for a read-only register or an address without a register, DATA_LENGTH for
        a part of a register, DATA_RANGE for a value outside its range.
        """
        if not data:
            raise InstructionRejected(StatusError.DATA_LENGTH)
        entries = []
        i = 0
        while i < len(data):
            register = self._at.get(address + i)
            if register is None:
                raise InstructionRejected(
                    StatusError.DATA_LENGTH if self._within_register(address + i) else StatusError.ACCESS
                )
            if register.name in _READ_ONLY:
                raise InstructionRejected(StatusError.ACCESS)
            if i + register.size > len(data):
                raise InstructionRejected(StatusError.DATA_LENGTH)
            value = register.decode(data[i : i + register.size])
            allowed = self._ranges.get(register.name)
            if allowed is not None and value not in allowed:
                raise InstructionRejected(StatusError.DATA_RANGE)
            entries.append((register, value))
            i += register.size
        return entries

    def _within_register(self, address: int) -> bool:
        return any(a in self._at and a + self._at[a].size > address for a in range(address - 3, address))

    def _restore(self, start: int, end: int) -> None:
        for register in self._registers.values():
            if start <= register.address < end:
                self[register.name] = self._defaults.get(register.name, 0)
