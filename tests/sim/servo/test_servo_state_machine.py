"""The control table, compared with a small model of the e-manual's rules, under any sequence of instructions."""

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from sim.servo.device import BOOT_S, OVERLOAD_ERROR
from sim.servo.protocol2 import StatusError
from tests.fuzzing import examples
from tests.sim.servo.servo_bench import ALERT, Line

EEPROM = {"Return Delay Time": 250, "Moving Threshold": 10, "Min Position Limit": 0, "Max Position Limit": 4095}
RAM = {"LED": 0, "Profile Velocity": 0, "Profile Acceleration": 0, "Position P Gain": 640}
LARGEST = {
    "Return Delay Time": 254,
    "Moving Threshold": 1023,
    "Min Position Limit": 4095,
    "Max Position Limit": 4095,
    "LED": 1,
    "Profile Velocity": 32_767,
    "Profile Acceleration": 32_767,
    "Position P Gain": 16_383,
}
READ_ONLY = ["Model Number", "Present Position", "Moving", "Hardware Error Status", "Realtime Tick"]
EXTENDED_LIMIT = 1_048_575


class ServoMachine(RuleBasedStateMachine):
    @initialize(model=st.sampled_from(["xl430_w250", "mx_28"]))
    def power_up(self, model: str) -> None:
        self.line = Line()
        self.servo = self.line.add(1, model)
        gain = self.servo.model.initial["Position P Gain"]
        # e-manual of the MX-28 (2.0): its limits of velocity and acceleration also limit the profile
        self.largest_profile = {"Profile Velocity": 230, "Profile Acceleration": 32_767} if model == "mx_28" else {}
        self.initial_ram = RAM | {"Position P Gain": gain}
        self.eeprom = dict(EEPROM)
        self.ram = dict(self.initial_ram)
        self.mode = 3
        self.torque = 0
        self.goal: int | None = None  # what was last set while torque is on
        self.shut_down = False
        self.waiting: tuple[str, int] | None = None

    def write(self, name: str, value: int) -> int:
        error = self.line.write(name, value)
        assert bool(error & ALERT) is self.shut_down
        return error & ~ALERT

    def expected_error(self, name: str, value: int) -> StatusError:
        if not 0 <= value <= LARGEST[name]:
            return StatusError.DATA_RANGE
        if name.startswith("Profile") and value > self.largest_profile.get(name, value):
            return StatusError.DATA_LIMIT
        return StatusError.ACCESS if name in EEPROM and self.torque else StatusError.NONE

    def keep(self, name: str, value: int) -> None:
        (self.eeprom if name in EEPROM else self.ram)[name] = value

    @rule(name=st.sampled_from([*EEPROM, *RAM]), data=st.data())
    def write_setting(self, name: str, data: st.DataObject) -> None:
        size = self.line.table(1)[name].size
        value = data.draw(st.integers(0, min(LARGEST[name] + 2, 256**size - 1)))
        expected = self.expected_error(name, value)
        assert self.write(name, value) == expected
        if expected is StatusError.NONE:
            self.keep(name, value)

    @rule(name=st.sampled_from(READ_ONLY), value=st.integers(0, 1))
    def write_read_only(self, name: str, value: int) -> None:
        assert self.write(name, value) == StatusError.ACCESS

    @rule(on=st.integers(0, 1))
    def switch_torque(self, on: int) -> None:
        assert self.write("Torque Enable", on) == 0
        if on and not self.shut_down:
            if not self.torque:
                self.goal = None
            self.torque = 1
        elif not on:
            self.torque = 0

    @rule(mode=st.sampled_from([0, 1, 2, 3, 4, 5, 16]))
    def change_mode(self, mode: int) -> None:
        known = mode in (1, 3, 4)
        expected = (
            StatusError.ACCESS if known and self.torque else StatusError.NONE if known else StatusError.DATA_RANGE
        )
        assert self.write("Operating Mode", mode) == expected
        if expected is StatusError.NONE:
            self.mode = mode
            self.ram |= {
                n: self.initial_ram[n] for n in ("Profile Velocity", "Profile Acceleration", "Position P Gain")
            }

    @rule(goal=st.integers(-5000, 9000) | st.sampled_from([EXTENDED_LIMIT, EXTENDED_LIMIT + 1, -EXTENDED_LIMIT - 1]))
    def set_goal(self, goal: int) -> None:
        low, high = -EXTENDED_LIMIT, EXTENDED_LIMIT
        if self.mode == 3:
            low, high = self.eeprom["Min Position Limit"], self.eeprom["Max Position Limit"]
        expected = StatusError.NONE if low <= goal <= high else StatusError.DATA_LIMIT
        assert self.write("Goal Position", goal) == expected
        if expected is StatusError.NONE and self.torque and self.mode != 1:
            self.goal = goal

    @rule()
    def overload(self) -> None:
        self.servo.fail(OVERLOAD_ERROR)
        self.shut_down = True
        self.torque = 0

    @rule(by_instruction=st.booleans())
    def reboot(self, by_instruction: bool) -> None:
        if by_instruction:
            self.line.sdk.reboot(self.line.port, 1)
        else:
            self.servo.power_cycle()
        self.line.sleep(BOOT_S + 0.01)
        self.ram = dict(self.initial_ram)
        self.torque, self.shut_down = 0, False
        assert 0 <= self.line.read("Present Position") < 4096

    @rule(seconds=st.floats(0.01, 30.0))
    def wait(self, seconds: float) -> None:
        self.line.sleep(seconds)

    @precondition(lambda self: self.torque and self.mode != 1 and self.goal is not None)
    @rule()
    def arrive(self) -> None:
        remaining_s = self.servo.motor.commanded.end_s - self.line.clock.now_ns() * 1e-9
        if remaining_s > 300:
            return  # hundreds of revolutions at a low speed
        self.line.sleep(remaining_s)
        assert self.line.read("Present Position") == self.goal
        assert self.line.read("Moving Status") & 0x03 == 0x01

    @invariant()
    def memory_is_as_modelled(self) -> None:
        memory = self.servo.memory
        assert {name: memory[name] for name in EEPROM} == self.eeprom
        assert {name: memory[name] for name in RAM} == self.ram
        assert (memory["Torque Enable"], memory["Operating Mode"]) == (self.torque, self.mode)
        assert memory["Hardware Error Status"] == (OVERLOAD_ERROR if self.shut_down else 0)


TestServo = ServoMachine.TestCase
TestServo.settings = settings(examples(7), stateful_step_count=30)
