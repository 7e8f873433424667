"""The decoders in C and in Python accept the same frames, with the same content.

The nightly profile decodes a million lines, CI some thousands. The C side runs with UBSan, and with ASan if the
compiler has it. ASan must be loaded when a process starts, so another process decodes the lines.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

from sim.head import build

NIGHTLY_LINES, LINES = 1_000_000, 4_000

PROGRAM = """
import ctypes, random, sys
from rig.devices.head.link import HeadFrame, HeadStatistics, LONGEST, decode, encode

library, count, seed = ctypes.CDLL(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
library.frame_decode.restype = ctypes.c_int8
library.frame_encode.restype = ctypes.c_uint8
draw = random.Random(seed)
frames = errors = 0
for number in range(count):
    body = draw.randbytes(draw.randrange(MAX_BODY + 1))
    if draw.random() < 0.5:
        body = body.translate(bytes(b if b % 3 else 0 for b in range(256)))
    frame = HeadFrame(draw.randrange(256), draw.randrange(256), body)
    line = encode(frame)
    room = ctypes.create_string_buffer(bytes([frame.id, frame.sequence]) + body, len(body) + 4)
    out = ctypes.create_string_buffer(LONGEST)
    length = library.frame_encode(out, room, len(body))
    assert out.raw[:length] == line, frame
    wire = bytearray(line[:-1])
    kind = number % 4
    if kind == 1:  # bits that flip
        for _ in range(draw.randrange(1, 4)):
            wire[draw.randrange(len(wire))] ^= 1 << draw.randrange(8)
    elif kind == 2:  # bytes that are lost, doubled or inserted
        at = draw.randrange(len(wire))
        wire[at : at + draw.randrange(3)] = draw.randbytes(draw.randrange(3))
    elif kind == 3:
        wire = bytearray(draw.randbytes(draw.randrange(LONGEST + 8)))
    raw = ctypes.create_string_buffer(bytes(wire), len(wire)) if wire else ctypes.create_string_buffer(1)
    length = library.frame_decode(raw, len(wire))
    found = HeadStatistics()
    expected = decode(bytes(wire), found)
    if expected is None:
        assert length == (-2 if found.crc_errors else -1), (wire, length)
        errors += 1
    else:
        assert length == len(expected.body), (wire, length)
        assert raw.raw[: length + 2] == bytes([expected.id, expected.sequence]) + expected.body
        frames += 1
assert frames > count // 5 and errors > count // 3, (frames, errors)
print(frames, errors)
""".replace("MAX_BODY", "(LONGEST - 6)")


@pytest.fixture
def compiler():
    if lacking := build.missing():
        pytest.skip(lacking)


def runtime(name: str) -> str:
    """Return the path of a sanitizer's runtime; empty if the compiler has none."""
    reported = subprocess.run(
        [build.compiler(), f"-print-file-name={name}"], capture_output=True, text=True, check=True
    )
    path = Path(reported.stdout.strip())
    return str(path) if path.is_absolute() else ""


@pytest.mark.nightly
def test_both_decoders_accept_the_same_frames(compiler):
    nightly = settings.get_current_profile_name() == "nightly"
    asan = runtime("libasan.so")
    flags = "-g -fsanitize=address,undefined -fno-sanitize-recover" if asan else "-g"
    library = build.made(flags=flags)
    environment = {**os.environ, "LD_PRELOAD": asan, "ASAN_OPTIONS": "detect_leaks=0"}  # Python's own are not ours
    count, seed = (NIGHTLY_LINES, os.getpid()) if nightly else (LINES, 1)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(library), str(count), str(seed)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"seed {seed}: {done.stderr[-3000:]}"
