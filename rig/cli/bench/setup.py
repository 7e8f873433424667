"""`rig setup`: from a box of parts to a rig.toml."""

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from rig.cli.ui import prompts
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.bench.computer import DeviceFile
    from rig.config.toml_file import Key
    from rig.doctor.context import DoctorContext
    from rig.doctor.device_scan import DeviceScan

T = TypeVar("T")

SMALLEST_REACH_DEG, LARGEST_REACH_DEG = 180.0, 90_000.0


@command
def setup(
    settings: Settings,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Ask nothing: take what leaves no choice, leave what does.")
    ] = False,
) -> None:
    """Find servo, IMU and camera, ask what cannot be found out, and write a commented rig.toml; then see a doctor.

    An existing file keeps its comments and everything that was not asked about. Nothing moves; Ctrl+C leaves the file
    untouched.

    Example: rig setup --bench sim --yes
    """
    from rig.cli.bench.doctor import examination
    from rig.cli.bench.examination import doctor_context
    from rig.config import RigConfig
    from rig.config.toml_file import read_text, save, stated, with_values
    from rig.config.values import FILE_NAME, default_path
    from rig.config.wording import blank_file

    path = settings.config or default_path() or Path(FILE_NAME)
    there = path.exists()
    now = settings if there else replace(settings, config=None, _loaded={})
    out = sys.stderr if settings.json else sys.stdout
    with doctor_context(now) as context:
        context.require_free()
        dialogue = Dialogue(context, ask_nothing=yes or settings.json, out=out)
        wanted = dialogue.run()
        if settings.bench and settings.bench != context.config.default_bench:
            wanted[("default_bench",)] = settings.bench
        old = read_text(path) if there else blank_file(RigConfig)
        changes = {key: value for key, value in wanted.items() if not there or _in_force(context.config, key) != value}
        new = with_values(old, changes)
        write = not there or new != old
        lines = [f"{'.'.join(key)} = {stated(key, value)}" for key, value in changes.items()]
        if write and not dialogue.ask_nothing:
            print("\n".join(["", f"{path}{'' if there else ' (new)'}:", *(f"  {line}" for line in lines)]), file=out)
            write = prompts.ask_yes_no(f"Write {path}?", default=True)
    if write:
        save(path, new)
    done = f"Wrote {path}." if write else f"{path} is left as it is."
    after = replace(settings, config=settings.config if path.exists() else None, _loaded={})
    if settings.json:
        settings.print_json({"path": path, "written": write, "settings": {".".join(k): v for k, v in changes.items()}})
    else:
        print(f"{done}\n")
    code = examination(after)
    if not settings.json:
        print(_next(context, code))
    if code:
        raise typer.Exit(code)


@dataclass
class Dialogue:
    """Finds the devices of a bench, asking the person where there is a choice."""

    context: "DoctorContext"
    ask_nothing: bool
    out: Any
    wanted: "dict[Key, Any]" = field(default_factory=dict)

    def run(self) -> "dict[Key, Any]":
        """Return the keys of the configuration that were found out."""
        from rig.doctor.device_scan import DeviceScan, camera_settings, head_settings, imu_settings, servo_settings

        scan = DeviceScan()
        self._scan(scan)
        while not scan.servos and not scan.duplicate_ids and self._again("No servo was found."):
            scan = DeviceScan()
            self._scan(scan)
        computer = self.context.computer
        servo = self._pick("servo", scan.servos, [f"{p.path}: {s}" for p, s in scan.servos], lambda pair: pair[0])
        if servo is not None:
            self.wanted |= servo_settings(*servo)
            if computer.same_file(servo[0].path, self.context.config.servo.port) and self._configured("servo", "port"):
                self.wanted[("servo", "port")] = self.context.config.servo.port  # a name that a person chose
            self._permanent_settings()
        elif not scan.servos:
            self._which_port()
        imus = [(str(found), imu_settings(found)) for found in scan.imus]
        imus += [(f"on the rig head at {port.path}", head_settings(port)) for port in scan.heads]
        imu = self._pick("IMU", imus, [shown for shown, _ in imus])
        if imu is not None:
            self.wanted |= imu[1]
            if self.context.config.imu.connection == "head" and ("imu", "connection") not in imu[1]:
                self.wanted[("imu", "connection")] = "i2c"
        shown = [f"{c.node.path}: {c.node.name}, {c.width}x{c.height}" for c in scan.cameras]
        camera = self._pick("camera", scan.cameras, shown, lambda found: found.node)
        if camera is not None:
            self.wanted |= camera_settings(camera)
        self._reach()
        return self.wanted

    def _scan(self, scan: "DeviceScan") -> None:
        from rich.console import Console

        from rig.cli.bench.examination import print_finding, say
        from rig.doctor.examination import run_checks

        screen = Console(file=self.out)
        for finding in run_checks(self.context, scan.checks, say):
            print_finding(screen, finding)

    def _again(self, what: str) -> bool:
        if self.ask_nothing:
            return False
        return prompts.ask_yes_no(f"{what} Look again, after you have checked cables and supply?", default=False)

    def _pick(
        self, what: str, found: Sequence[T], shown: Sequence[str], node: "Callable[[T], DeviceFile] | None" = None
    ) -> T | None:
        """Return the one that there is, or the one that the person means; None where there is none or no saying."""
        if len(found) <= 1:
            return found[0] if found else None
        if self.ask_nothing:
            print(
                f"! {len(found)} devices could be the {what}; the configuration stays as it is for it.", file=self.out
            )
            return None
        nodes = [node(each) for each in found] if node else []
        several = len({each.path for each in nodes}) > 1
        index = prompts.ask_choice(
            f"Which is the table's {what}?", shown, other="find out by unplugging it" if several else ""
        )
        if index is not None:
            return found[index]
        pulled = self._pulled(what, lambda: [*self.context.computer.serial_ports(), *self.context.computer.cameras()])
        return next((each for each, its in zip(found, nodes, strict=True) if pulled and its.path == pulled.path), None)

    def _pulled(self, what: str, there: "Callable[[], Sequence[DeviceFile]]") -> "DeviceFile | None":
        """Find out which device file belongs to a device by having it unplugged and plugged in again."""
        before = there()
        while True:
            prompts.ask_line(f"Unplug the {what}'s USB cable, then press Enter.")
            left = {node.path for node in there()}
            gone = [node for node in before if node.path not in left]
            prompts.ask_line("Plug it in again, then press Enter.")
            if len(gone) == 1:
                print(f"It is {gone[0].path} ({gone[0].name}).", file=self.out)
                return gone[0]
            print(f"{len(gone) or 'No'} device{'s' if len(gone) != 1 else ''} went away.", file=self.out)
            if not prompts.ask_yes_no("Try again?", default=True):
                return None

    def _which_port(self) -> None:
        """Without a servo that answers: at least its adapter may be known."""
        ports = [port for port in self.context.computer.serial_ports() if port.usb]
        port: DeviceFile | None = ports[0] if len(ports) == 1 else None
        if len(ports) > 1 and not self.ask_nothing:
            index = prompts.ask_choice(
                "Which is the servo's adapter?",
                [f"{each.path}: {each.name}" for each in ports],
                other="find out by unplugging it",
            )
            port = ports[index] if index is not None else self._pulled("adapter", self.context.computer.serial_ports)
        if port is not None and not self.context.computer.same_file(port.path, self.context.config.servo.port):
            self.wanted[("servo", "port")] = port.stable or port.path

    def _permanent_settings(self) -> None:
        """Show what of the servo's EEPROM stands in the way, and write it if the person agrees."""
        from rig.config.toml_file import Key
        from rig.core.errors import SeveralServos
        from rig.devices.dynamixel.settings import ServoMode, compare, write
        from rig.doctor.single_servo import single_servo

        key: Key = ("servo", "port")
        config = self.context.config
        found = config.servo.model_copy(update={"port": self.wanted[key]})
        context = replace(self.context, config=config.model_copy(update={"servo": found}))
        with suppress(SeveralServos), single_servo(context) as servo:
            differences = compare(servo.bus, servo.found.bus_id, servo.table, ServoMode(config.table.mode))
            if not differences:
                return
            print("The servo's permanent settings (EEPROM) are not as the rig needs them:", file=self.out)
            print("\n".join(f"  {difference}" for difference in differences), file=self.out)
            if self.ask_nothing:
                print(f"  left as they are; to write them: {context.rig('servo settings --write')}", file=self.out)
            elif prompts.ask_yes_no("Write them now, with the servo's torque off?", default=True):
                write(servo.bus, servo.found.bus_id, servo.table, differences)
                print("Written, and read back.", file=self.out)

    def _reach(self) -> None:
        """Ask for the cable's budget."""
        low, high = self.context.config.table.limits_deg
        if self.ask_nothing or self._configured("table", "limits_deg") or self.context.config.table.mode == "pan":
            return
        reach = prompts.ask_value(
            "How far may the table turn either way, in degrees, before the IMU's cable is taut?",
            min(-low, high),
            _degrees,
        )
        self.wanted[("table", "limits_deg")] = [-reach, reach]

    def _configured(self, section: str, key: str) -> bool:
        return key in getattr(self.context.config, section).model_fields_set


def _degrees(text: str) -> float:
    try:
        value = float(text.removesuffix("°"))
    except ValueError:
        raise ValueError(f"{text!r} is not a number.") from None
    if not SMALLEST_REACH_DEG <= value <= LARGEST_REACH_DEG:
        raise ValueError(f"Enter {SMALLEST_REACH_DEG:.0f}–{LARGEST_REACH_DEG:.0f} degrees: one revolution or more.")
    return value


def _in_force(config: Any, key: "Key") -> Any:
    for part in key:
        config = getattr(config, part)
    return list(config) if isinstance(config, tuple) else config


def _next(context: "DoctorContext", code: int) -> str:
    if code:
        return f"\nNext: what is marked ✗ above, then {context.rig('doctor')}."
    return f"\nNext: {context.rig('goto 90')} turns the table; then {context.rig('enroll NAME')}."
