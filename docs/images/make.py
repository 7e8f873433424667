"""Make the pictures of the README: real commands in a real terminal, drawn by rich and Chromium.

From the checkout: .venv/bin/python docs/images/make.py
"""

import os
import pty
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.terminal_theme import MONOKAI
from rich.text import Text

HERE = Path(__file__).parent
WIDTH, HEIGHT = 136, 32
STEP = re.compile(r"\x1b\[(?P<count>\d*)(?P<what>[A-Za-z])|\x1b\[\?25[hl]|(?P<break>\r?\n)|(?P<back>\r)")


def output(folder: Path, arguments: list[str]) -> str:
    """Run `rig` in a terminal and return what it printed."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(folder)
        os.environ |= {"COLUMNS": str(WIDTH), "LINES": str(HEIGHT), "TERM": "xterm-256color"}
        code = "from rig.cli.main import main; main()"
        os.execv(sys.executable, [sys.executable, "-c", code, *arguments])
    seen = b""
    while True:
        try:
            part = os.read(terminal, 4096)
        except OSError:  # the program has ended
            break
        if not part:
            break
        seen += part
    os.waitpid(pid, 0)
    os.close(terminal)
    return seen.decode(errors="replace")


def screen(text: str) -> list[str]:
    """Return the lines that stand on the screen in the end, colours included: what rich's live display needs."""
    lines, row, at = [""], 0, 0
    for step in STEP.finditer(text):
        lines[row] += text[at : step.start()]
        at = step.end()
        if step["break"]:
            row += 1
            if row == len(lines):
                lines.append("")
        elif step["what"] == "A":
            row -= int(step["count"] or 1)
        elif step["what"] == "K":
            lines[row] = ""
        elif step["what"] == "m":
            lines[row] += step[0]
    lines[row] += text[at:]
    return lines


def picture(name: str, command: str, lines: list[str]) -> None:
    """Write ``name``.png: the command, and what stood on the screen below it."""
    console = Console(record=True, width=WIDTH, file=open(os.devnull, "w"), force_terminal=True)  # noqa: SIM115, PTH123
    console.print(Text(f"$ {command}", style="bold"))
    for line in lines:
        console.print(Text.from_ansi(line))
    with tempfile.TemporaryDirectory() as folder:
        svg = Path(folder) / "picture.svg"
        svg.write_text(console.export_svg(title="rig", theme=MONOKAI), encoding="utf-8")
        width, height = (round(float(n)) for n in re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg.read_text())[0])
        page = Path(folder) / "page.html"
        page.write_text(f'<body style="margin:0"><img src="{svg}" width="{width}"></body>', encoding="utf-8")
        photograph(name, page, width, height)


def photograph(name: str, page: Path, width: int, height: int) -> None:
    """Write ``name``.png: the upper part of a page in a browser."""
    browser = next(b for b in ("chromium", "chromium-browser", "google-chrome") if shutil.which(b))
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
                "--disable-background-networking", f"--user-data-dir={profile}",
                f"--window-size={width},{height}", f"--screenshot={HERE / name}.png", f"file://{page}",
            ],
            check=True, capture_output=True,
        )  # fmt: skip


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lines = screen(output(folder, ["demo"]))
        enrolled = max(n for n, line in enumerate(lines) if "views enrolled in" in line)
        picture("demo", "make demo", [*lines[:3], "...", *lines[enrolled:]])


if __name__ == "__main__":
    main()
