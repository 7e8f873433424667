"""Commands of the trainee to the simulated world, such as ``put mug-white``, ``jam`` or ``rotate 90``."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

from rig.core.errors import RigError, UsageError
from rig.core.json_form import plain
from rig.core.next_steps import Do
from rig.core.phrases import angle_words, percent
from sim.bench import ShelfOperator
from sim.calibration_board import boards
from sim.devices import SimDevices
from sim.faults import Fault, Faults, fault_kinds
from sim.faults.kind import FaultTrigger
from sim.head.board import SimHead

HELP: Final = """\
put NAME [DEGREES]  Put an object on the table, rotated by so many degrees (default: at random). Clears the table first.
clear               Clear the table.
objects             List the objects.
rotate DEGREES      Rotate the table by hand, counter-clockwise. Works only while the torque is off.
light FACTOR        Change the light: 1 is the normal light, 0.5 half of it.
power-cycle         Switch the servo's supply off and on.
estop press         Press the emergency stop of the rig head; estop release releases it.
head unplug         Unplug the rig head's USB cable; head plug plugs it in again.
FAULT               Start a simulated fault: jam, unplug, imu.off, ...; jam@3s+2s starts in 3 s and ends 2 s later.
end [FAULT]         End a simulated fault; without a name, all. For example: end unplug
faults              List the simulated faults.
status              Show the world as it really is.
quit                End the simulated bench."""
_USAGE: Final = {line.split()[0]: line.split("  ")[0] for line in HELP.splitlines()}

MAX_LIGHT: Final = 10.0  # brighter than any lamp that a simulated bench needs
MAX_DEG: Final = 3600.0  # ten revolutions: more only takes long
_OF_ONE_PROGRAM: Final = ("disk_full", "clock_jump")


class Commands:
    """The commands of the trainee, which change a simulated world.

    ``ended`` is whether the trainee has ended the bench.
    """

    def __init__(self, operator: ShelfOperator, devices: SimDevices, faults: Faults) -> None:
        self.ended = False
        self._operator = operator
        self._devices = devices
        self._world = devices.world
        self._faults = faults

    def answer(self, words: Sequence[str]) -> dict[str, Any]:
        """Carry out a command; return the result, or the error, as plain data with the state of the world."""
        try:
            return {"text": self.do(words), "world": self.state()}
        except RigError as error:
            return {"failed": plain(error.problem), "world": self.state()}

    def do(self, words: Sequence[str]) -> str:
        """Carry out a command, and return the result in words.

        Raises `UsageError`, `ObjectNotFound`: there is no such command, object or fault, or it is not possible now.
        """
        match words:
            case [] | ["help"]:
                return HELP
            case ["put", name]:
                return self._put(name, None)
            case ["put", name, angle]:
                return self._put(name, _number(angle, "degrees", MAX_DEG))
            case ["clear"]:
                self._world.put(None)
                return "The table is empty."
            case ["objects"]:
                return "\n".join([*self._operator.objects, *boards(self._operator.optics)])
            case ["rotate", angle]:
                return self._rotate_by_hand(_number(angle, "degrees", MAX_DEG))
            case ["light", level]:
                factor = _number(level, "factor", MAX_LIGHT)
                if factor < 0:
                    raise UsageError("The light cannot be negative.", next_step="Give 0 (dark) or more.")
                self._world.change(light=(factor,) * 3)
                return f"The light is at {percent(factor, 0)}."
            case ["power-cycle"]:
                self._devices.servo.power_cycle()
                return "The servo's supply was off for a moment."
            case ["estop", "press" | "release" as action]:
                self._head().estop_open = action == "press"
                return f"The emergency stop is {'pressed' if action == 'press' else 'released'}."
            case ["head", "unplug" | "plug" as action]:
                self._head().unplugged = action == "unplug"
                return f"The rig head is {action}ged{' in' if action == 'plug' else ''}."
            case ["end"]:
                self._faults.clear()
                return "No simulated fault is left."
            case ["end", name]:
                return self._end(name)
            case ["faults"]:
                return "\n".join(f"{kind.name:18} {kind.what}" for kind in fault_kinds().values())
            case ["status"]:
                now = self.state()
                return (
                    f"On the table: {now['object'] or 'nothing'}. The table is at {angle_words(now['table_deg'])}, its "
                    f"torque {'on' if now['torque'] else 'off'}. Faults: {', '.join(now['faults']) or 'none'}."
                )
            case ["quit"]:
                self.ended = True
                return "The simulated bench ends."
            case [command, *_] if command in _USAGE:
                raise UsageError(f"{command!r} does not take these words.", next_step=f"Write: {_USAGE[command]}")
        return self._begin(" ".join(words))

    def state(self) -> dict[str, Any]:
        """Return the true state of the world as plain data."""
        scene, servo = self._world.scene, self._devices.servo
        return {
            "object": scene.object.name if scene.object else None,
            "object_deg": scene.yaw_deg % 360.0,
            "table_deg": self._world.table_deg(),
            "torque": bool(servo.memory["Torque Enable"]),
            "light": list(scene.light),
            "faults": [fault.kind.name for fault in self._faults.active],
        }

    def _put(self, name: str, yaw_deg: float | None) -> str:
        operator = self._operator
        if name not in {*operator.objects, *boards(operator.optics)}:
            raise UsageError(
                f"There is no object {name!r}.",
                next_step="Choose a listed object. To list them: objects",
                evidence={"objects": list(operator.objects)},
            )
        operator.next_object, operator.yaw_deg = name, yaw_deg
        operator.place(None)
        return f"{name} is on the table."

    def _rotate_by_hand(self, angle_deg: float) -> str:
        try:
            seconds = self._devices.servo.rotate_by_hand(angle_deg)
        except ValueError as held:
            raise UsageError("The servo holds the table.", next_step=Do.STOP()) from held
        return f"The table is rotated by {angle_words(angle_deg, None)} by hand, in {seconds:.1f} s."

    def _head(self) -> SimHead:
        if self._devices.head is None:
            step = Do.SIM_BENCH(set="imu.connection=head")
            raise UsageError("This bench has no rig head.", next_step=step)
        return self._devices.head

    def _begin(self, text: str) -> str:
        try:
            fault = Fault.parse(text)
        except UsageError as error:
            raise UsageError(
                f"There is no command or fault {text!r}.",
                next_step=(*error.steps, "For a list of all commands: rig sim-bench help"),
            ) from error
        name = fault.kind.name
        if name in _OF_ONE_PROGRAM:
            raise UsageError(
                f"{name} happens to the computer of one program, not to this bench.",
                next_step=f"Use it on the bench sim: rig demo --fault {name}",
            )
        if fault.trigger is not FaultTrigger.AT:
            step = f"Give the time from now on: {name}@5s"
            raise UsageError("Programs, not this bench, count their moves and views.", next_step=step)
        if any(active.kind is fault.kind for active in self._faults.active):
            raise UsageError(f"The fault {name} is already there.", next_step=f"End it: end {name}")
        self._faults.schedule(replace(fault, mark=fault.mark + self._world.clock.now_ns() * 1e-9))
        return f"{fault.kind.what} To end it: end {name}"

    def _end(self, name: str) -> str:
        if not self._faults.end(name):
            active = ", ".join(fault.kind.name for fault in self._faults.active)
            raise UsageError(
                f"The fault {name} is not there.",
                next_step=f"End one of: {active}" if active else "No simulated fault is there.",
            )
        return f"The fault {name} has ended."


def _number(text: str, meaning: str, largest: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) <= largest:  # also true for nan
        raise UsageError(f"{text!r} is not possible as {meaning}.", next_step=f"Give a number up to {largest:g}.")
    return value
