"""The exit codes of every command; the hundreds of an error's code are its exit code."""

from typing import Final

EXIT_DECLINED: Final = 1
EXIT_DEVICE: Final = 4
EXIT_QUALITY: Final = 6
EXIT_CATALOG: Final = 7
EXIT_UNKNOWN: Final = 8
EXIT_AMBIGUOUS: Final = 10
EXIT_INTERRUPTED: Final = 130

EXIT_CODES: Final = {
    0: "Success.",
    EXIT_DECLINED: "You answered no to a question, or the program has a bug.",
    2: "The command, an option or an argument is wrong.",
    3: "The configuration has a mistake.",
    EXIT_DEVICE: "A device does not answer, or it reports a fault.",
    5: "Motion or safety: the table did not start, or it was stopped.",
    EXIT_QUALITY: "No object is on the table; or a view, a calibration, a replay or a demo is not good enough.",
    EXIT_CATALOG: "The catalog cannot do this, or it is damaged.",
    EXIT_UNKNOWN: "The object is unknown.",
    9: "Another program uses the bench or the catalog.",
    EXIT_AMBIGUOUS: "The object is ambiguous: it may be one of several enrolled objects.",
    EXIT_INTERRUPTED: "You pressed Ctrl+C.",
    143: "A signal ended the program: 128 plus its number (SIGTERM 15, SIGHUP 1).",
}
"""Exit code and meaning, in the order of the help and of the reference."""
