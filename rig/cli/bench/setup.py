"""`rig setup`: find the devices and write a rig.toml."""

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from rig.cli.bench.doctor import doctor_context, show_findings
from rig.cli.ui import prompts
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings
from rig.core.errors import SeveralServos
from rig.core.next_steps import Do

if TYPE_CHECKING:
    from rig.bench.computer import DeviceFile
    from rig.config.toml_file import Key
    from rig.doctor.context import DoctorContext
    from rig.doctor.device_scan import DeviceCandidate, DeviceScan

MIN_BUDGET_DEG, MAX_BUDGET_DEG = 180.0, 90_000.0
_PORT: Final = ("servo", "port")


@command
def setup(
    settings: Settings,
    yes: Annotated[
        bool,
        typer.Option("--yes", "-y", help="Ask nothing: use the devices that are unambiguous, and change nothing else."),
    ] = False,
) -> None:
    """Find servo, IMU and camera, ask for the rest, write a commented rig.toml, and run `rig doctor`.

    An existing file keeps its comments and all other settings. Nothing moves. Ctrl+C leaves the file unchanged.

    Example: rig setup --bench sim --yes
    """
    from rig.cli.bench.doctor import print_findings
    from rig.config import RigConfig, load_config
    from rig.config.toml_file import read_text, save, stated, with_values
    from rig.config.values import FILE_NAME, default_path
    from rig.config.wording import blank_file

    path = settings.config or default_path() or Path(FILE_NAME)
    there = path.exists()
    # A new file has no settings of the file in force: that may belong to another bench.
    now = settings if there else replace(settings, config=None, search=False)
    stored = load_config(path) if there else RigConfig()
    out = sys.stderr if settings.json else sys.stdout
    with doctor_context(now) as context:
        context.require_free()
        simulated = context.computer.simulated
        real = "" if settings.bench else " For the real bench: rig setup --bench hardware"
        print(f"Bench {context.bench}{f', with simulated devices.{real}' if simulated else ':'}", file=out)
        dialogue = Dialogue(context, ask_nothing=yes or settings.json, out=out)
        wanted = dialogue.run()
        if simulated:  # the devices in the file are real ones
            missing = [key for key in wanted if key[-1] not in _at(stored, key[:-1]).model_fields_set]
            wanted = {key: wanted[key] for key in missing}
        if stored.default_bench != context.bench:
            wanted[("default_bench",)] = context.bench
        old = read_text(path) if there else blank_file(RigConfig)
        changes = {key: value for key, value in wanted.items() if not there or _at(stored, key) != value}
        new = with_values(old, changes)
        write = not there or new != old
        lines = [f"{'.'.join(key)} = {stated(key, value)}" for key, value in changes.items()]
        if write and not dialogue.ask_nothing:
            print("\n".join(["", f"{path}{'' if there else ' (new)'}:", *(f"  {line}" for line in lines)]), file=out)
            write = prompts.ask_yes_no(f"Write {path}?", default=True)
    if write:
        save(path, new)
    done = f"Wrote {path}." if write else f"{path} is unchanged."
    after = replace(settings) if path.exists() else now  # a copy reads the file again
    written = {".".join(key): value for key, value in changes.items()}
    settings.say(f"{done}\n", {"path": path, "written": write, "settings": written})
    code = print_findings(after)["exit_code"]
    if not settings.json:
        rotate, enroll, check = (context.step(one).command for one in (Do.GOTO(angle=90), Do.ENROLL(), Do.DOCTOR()))
        move = f"rotate the table with {rotate}, then enroll with {enroll}."
        fix = f"fix the findings marked ✗, then run {check}."
        print(f"\nNext: {fix if code else move}")
    if code:
        raise typer.Exit(code)


@dataclass
class Dialogue:
    """The dialogue of `rig setup`: finds the devices of a bench, and asks if there is a choice."""

    context: "DoctorContext"
    ask_nothing: bool
    out: Any
    wanted: "dict[Key, Any]" = field(default_factory=dict)

    def run(self) -> "dict[Key, Any]":
        """Return the settings that were found or entered, by key."""
        scan = self._scan()
        again = "No servo that the rig can drive was found. Check cables and supply. Search again?"
        while not (scan.servos or scan.duplicate_ids or self.ask_nothing) and prompts.ask_yes_no(again):
            scan = self._scan()
        config, found = self.context.config, scan.candidates
        if (servo := self._pick("servo", found["servo"])) is not None:
            self.wanted |= servo.settings
            path = config.servo.port
            if self._configured("servo", "port") and self.context.computer.same_file(servo.settings[_PORT], path):
                self.wanted[_PORT] = path  # keep the configured name
            self._permanent_settings()
        elif not scan.servos:
            self._which_port()
        if (imu := self._pick("IMU", found["IMU"])) is not None:
            if config.imu.connection == "head":
                self.wanted[("imu", "connection")] = "i2c"
            self.wanted |= imu.settings
        if (camera := self._pick("camera", found["camera"])) is not None:
            self.wanted |= camera.settings
        self._cable_budget()
        return self.wanted

    def _scan(self) -> "DeviceScan":
        from rig.cli.ui.present import console
        from rig.doctor.device_scan import DeviceScan

        scan = DeviceScan()
        show_findings(console(stderr=self.out is sys.stderr), self.context, scan.checks)
        return scan

    def _pick(self, what: str, found: "Sequence[DeviceCandidate]") -> "DeviceCandidate | None":
        """Return the only device, or the one that the operator chooses; None without a choice."""
        if len(found) <= 1:
            return found[0] if found else None
        if self.ask_nothing:
            print(f"! {len(found)} devices could be the {what}; its configuration is unchanged.", file=self.out)
            return None
        index = prompts.ask_choice(f"Which is the table's {what}?", [one.words for one in found])
        return found[index]

    def _which_port(self) -> None:
        """Find the servo's adapter although no servo answers."""
        ports = [port for port in self.context.computer.serial_ports() if port.usb]
        port: DeviceFile | None = ports[0] if len(ports) == 1 else None
        if len(ports) > 1 and not self.ask_nothing:
            words = [f"{each.path}: {each.name}" for each in ports]
            port = ports[prompts.ask_choice("Which is the servo's adapter?", words)]
        if port is not None and not self.context.computer.same_file(port.path, self.context.config.servo.port):
            self.wanted[_PORT] = port.stable or port.path

    def _permanent_settings(self) -> None:
        """Show the differing settings of the servo's EEPROM, and write them if the operator agrees."""
        from rig.devices.dynamixel.settings import compare, write
        from rig.doctor.single_servo import single_servo

        config = self.context.config
        found = config.servo.model_copy(update={"port": self.wanted[_PORT]})
        context = replace(self.context, config=config.model_copy(update={"servo": found}))
        with suppress(SeveralServos), single_servo(context) as servo:
            differences = compare(servo.bus, servo.found.bus_id, servo.table, config.table.mode)
            if not differences:
                return
            print("Some permanent settings of the servo (EEPROM) differ from the required ones:", file=self.out)
            print("\n".join(f"  {difference}" for difference in differences), file=self.out)
            if self.ask_nothing:
                print(f"  not changed; to write them: {context.step(Do.SERVO_SETTINGS()).command}", file=self.out)
            elif prompts.ask_yes_no("Write them now, with the servo's torque off?", default=True):
                write(servo.bus, servo.found.bus_id, servo.table, differences)
                print("Written and verified.", file=self.out)

    def _cable_budget(self) -> None:
        """Ask for the cable budget."""
        low, high = self.context.config.table.limits_deg
        if self.ask_nothing or self._configured("table", "limits_deg") or self.context.config.table.mode == "pan":
            return
        budget = prompts.ask_value(
            "How far can the table rotate in each direction, in degrees, before the IMU's cable is taut?",
            min(-low, high),
            _degrees,
        )
        self.wanted[("table", "limits_deg")] = [-budget, budget]

    def _configured(self, section: str, key: str) -> bool:
        return key in getattr(self.context.config, section).model_fields_set


def _degrees(text: str) -> float:
    try:
        value = float(text.removesuffix("°"))
    except ValueError:
        raise ValueError(f"{text!r} is not a number.") from None
    if not MIN_BUDGET_DEG <= value <= MAX_BUDGET_DEG:
        raise ValueError(f"Enter {MIN_BUDGET_DEG:.0f}–{MAX_BUDGET_DEG:.0f} degrees: one revolution or more.")
    return value


def _at(config: Any, key: "Key") -> Any:
    """Return a value of a configuration, or a section of it."""
    for part in key:
        config = getattr(config, part)
    return list(config) if isinstance(config, tuple) else config
