"""`rig find`."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.bench.examination import case_of, print_finding, say
from rig.cli.ui.command import command
from rig.cli.ui.settings import Settings

if TYPE_CHECKING:
    from rig.config.toml_file import Key
    from rig.doctor.finding import Finding
    from rig.doctor.survey import Survey


@command
def find(
    settings: Settings,
    both_protocols: Annotated[
        bool, typer.Option("--all", help="Ask for AX-12A (protocol 1.0) even where other servos answered; a minute.")
    ] = False,
) -> None:
    """List what is connected: servos at all baud rates, IMUs, cameras; and say what to write into rig.toml.

    Asks only; nothing is written or moved.

    Example: rig find --bench sim
    """
    from rig.cli.ui.present import console
    from rig.config.toml_file import with_values
    from rig.doctor.examination import examine
    from rig.doctor.survey import Survey

    screen = console()
    findings: list[Finding] = []
    survey = Survey(both_protocols)
    with case_of(settings) as case:
        case.require_free()
        for finding in examine(case, survey.checks, say):
            findings.append(finding)
            if not settings.json:
                print_finding(screen, finding)
    wanted = proposal(survey)
    if settings.json:
        settings.print_json(
            {
                "findings": [finding.as_dict() for finding in findings],
                "settings": {".".join(key): value for key, value in wanted.items()},
            }
        )
    elif wanted:
        print(f"\nFor rig.toml (`rig setup` writes it):\n\n{with_values('', wanted)}", end="")
    if not wanted:
        raise typer.Exit(4)


def proposal(survey: "Survey") -> "dict[Key, Any]":
    """Return the settings that leave no choice: of devices of which there is one."""
    from rig.doctor.survey import camera_settings, head_settings, imu_settings, servo_settings

    wanted: dict[Key, Any] = {}
    if len(survey.servos) == 1 and not survey.doubtful:
        wanted |= servo_settings(*survey.servos[0])
    if len(survey.heads) == 1 and not survey.imus:
        wanted |= head_settings(survey.heads[0])
    if len(survey.imus) == 1 and not survey.heads:
        wanted |= imu_settings(survey.imus[0])
    if len(survey.cameras) == 1:
        wanted |= camera_settings(survey.cameras[0])
    return wanted
