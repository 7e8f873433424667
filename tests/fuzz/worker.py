"""Runs commands of `rig`, each in a process of its own with limits: a line of JSON in, a line of JSON out.

It imports everything once and has one thread only, so that a fork takes milliseconds and is safe.
"""

import json
import os
import resource
import signal
import sys
from pathlib import Path

from tests.fuzzing import MAX_CPU_S, MAX_MEMORY

MAX_WAIT_S = 40
"""Time after which a command without computing counts as hanging; long enough for a busy computer."""
MAX_OUTPUT = 1 << 20


def main() -> None:
    import cv2

    import rig.catalog.exchange.bundle
    import rig.evaluation.run
    import rig.plans.identify
    import rig.report
    import rig.search.replay
    import sim.bench  # noqa: F401
    from rig.cli.main import main as rig

    cv2.setNumThreads(1)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    for line in sys.stdin:
        request = json.loads(line)
        folder = Path(request["folder"])
        child = os.fork()
        if not child:
            answers.close()
            run(rig, request["arguments"], folder)
        _, status, used = os.wait4(child, 0)
        output = {name: (folder / name).read_bytes()[:MAX_OUTPUT] for name in ("out", "err")}
        answer = {
            "exit_code": os.waitstatus_to_exitcode(status),
            "memory_bytes": used.ru_maxrss * 1024,
            "cpu_s": used.ru_utime + used.ru_stime,
            **{name: content.decode(errors="surrogateescape") for name, content in output.items()},
        }
        print(json.dumps(answer), file=answers, flush=True)


def run(rig, arguments: list[str], folder: Path) -> None:
    """Run one command in this process, with limits, empty standard input, and output into files."""
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_MEMORY, MAX_MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.alarm(MAX_WAIT_S)
    for number, name in ((0, os.devnull), (1, folder / "out"), (2, folder / "err")):
        os.dup2(os.open(name, os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    os.chdir(folder / "inside")
    sys.argv = ["rig", *(os.fsdecode(os.fsencode(argument)) for argument in arguments)]
    code = 1
    try:
        rig()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code & 0xFF)


if __name__ == "__main__":
    main()
