"""The server of a simulated bench for other programs: its camera, its I2C bus, and the trainee's commands.

A request is one line of JSON. The answer is also one line of JSON, followed by the number of raw bytes in its field
``bytes``. An invalid request ends only its own connection.
"""

import json
import socket
import socketserver
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import cv2

from rig.core.clock import SystemClock
from rig.core.files import json_values
from sim.camera import SELECT_S
from sim.devices import SimDevices
from sim.i2c import SimI2cBus
from sim.realtime.commands import Commands
from sim.realtime.pace import RealTime
from sim.realtime.wire import SOCKET, short_path

MAX_LINE: Final = 100_000  # longer than all commands: a program that sends something else must not fill the memory
_POLL_S: Final = 0.05
"""Period with which the wait for a frame checks whether the camera was unplugged."""

Answer = tuple[dict[str, Any], bytes]


class InvalidRequest(ValueError):
    """The line is no request."""


class ClientSession:
    """Answers the requests of one connection."""

    def __init__(self, bench: "BenchServer") -> None:
        self._bench = bench
        self._devices, self._time = bench.devices, bench.time

    def answer(self, request: Any) -> Answer:
        """Return the answer; raises `InvalidRequest`."""
        match request:
            case {"ask": "do", "words": [*words]} if all(isinstance(word, str) for word in words):
                with self._time.present():
                    answer = self._bench.commands.answer(words)
                with self._time.present():  # a port that was unplugged has disappeared before the answer
                    return answer, b""
            case {"ask": "i2c", "messages": [*messages]}:
                return self._i2c(messages)
            case {"ask": "camera", "call": "wait", "given": [int() | float() as seconds]} if seconds >= 0:
                return {"value": self._wait(min(seconds, SELECT_S))}, b""
            case {"ask": "camera", "call": str(call), "given": [*given]}:
                with self._time.present():
                    return self._camera(call, given)
        raise InvalidRequest

    def close(self) -> None:
        """Close the camera if the connection has it open."""
        with self._time.present():
            if self._bench.camera_user is self:
                self._bench.camera_user = None
                self._devices.camera.release()

    # -- camera -----------------------------------------------------------------------------------------------------

    def _camera(self, call: str, given: list[Any]) -> Answer:
        """Return the value of a call; None for the calls of a program that has not opened the camera."""
        camera, bench = self._devices.camera, self._bench
        value: object = None
        match call, given:
            case "node", []:
                value = camera.node()
            case "open", [] if bench.camera_user not in (None, self):
                value = "busy"
            case "open", []:
                value = "open" if camera.reopen() else "unplugged"
                bench.camera_user = self if value == "open" else None
            case _ if bench.camera_user is not self:
                pass
            case "release", []:
                self.close()
            case "isOpened", []:
                value = camera.isOpened()
            case "grab", []:
                value = not camera.wait_ns() and camera.grab()  # it must not wait here, where it would hold the world
            case "retrieve", []:
                _, image = camera.retrieve()
                if image is not None:
                    return {"value": image.shape}, image.tobytes()
            case "get", [cv2.CAP_PROP_POS_MSEC]:
                stamp_ms = camera.get(cv2.CAP_PROP_POS_MSEC)
                value = self._time.system_ns(round(stamp_ms * 1e6)) * 1e-6 if stamp_ms > 0 else stamp_ms
            case "get", [int() as number]:
                value = camera.get(number)
            case "set", [int() as number, int() | float() as wanted]:
                value = camera.set(number, wanted)
            case _:
                raise InvalidRequest
        return {"value": value}, b""

    def _wait(self, seconds: float) -> bool:
        """Wait for the next frame, without holding the world meanwhile; return whether it is there."""
        camera, deadline_ns = self._devices.camera, self._time.now_ns() + round(seconds * 1e9)
        while True:
            self._time.wait()
            with self._time.present():
                wait_ns = camera.wait_ns()
            if not wait_ns:
                return True
            if self._time.over or (left_ns := deadline_ns - self._time.now_ns()) <= 0:
                return False
            SystemClock().sleep(min(wait_ns * 1e-9, left_ns * 1e-9, _POLL_S))

    # -- I2C --------------------------------------------------------------------------------------------------------

    def _i2c(self, messages: list[Any]) -> Answer:
        bus = self._devices.i2c
        if not isinstance(bus, SimI2cBus):
            raise InvalidRequest
        transfer = [_message(*each) for each in messages if isinstance(each, list) and len(each) == 2]
        if len(transfer) < len(messages):
            raise InvalidRequest
        with self._time.present():
            try:
                answer: Answer = {"errno": 0}, b"".join(bus.transfer(transfer))
            except OSError as error:
                answer = {"errno": error.errno}, b""
        self._time.wait()  # a transfer takes time
        return answer


def _message(address: Any, content: Any) -> tuple[int, bytes | int]:
    """Return a message that writes the bytes in a text, or reads a number of bytes."""
    match address, content:
        case int(), int() if 0 <= address < 128 and content >= 0:
            return address, content
        case int(), str() if 0 <= address < 128:
            return address, bytes.fromhex(content)
    raise InvalidRequest


class _Handler(socketserver.StreamRequestHandler):
    """Answers one connection in its own thread."""

    server: "BenchServer"

    def handle(self) -> None:
        session, bench = ClientSession(self.server), self.server
        bench.connections.add(self.connection)
        try:
            while line := self.rfile.readline(MAX_LINE):
                answer, payload = session.answer(json_values(line))
                self.wfile.write(json.dumps({**answer, "bytes": len(payload)}).encode() + b"\n" + payload)
                bench.time.over |= bench.commands.ended  # only now, so that the command to end it is answered
        except (ValueError, OverflowError, OSError):  # no request, or the program has ended
            pass
        finally:
            session.close()
            bench.connections.discard(self.connection)

    def finish(self) -> None:
        with suppress(OSError):
            super().finish()


class BenchServer(socketserver.ThreadingMixIn, socketserver.UnixStreamServer):
    """Listens at a socket in ``folder``. Its end ends the connections."""

    daemon_threads = True

    def __init__(self, folder: Path, devices: SimDevices, time: RealTime, commands: Commands) -> None:
        self.devices, self.time, self.commands = devices, time, commands
        self.camera_user: ClientSession | None = None
        self.connections: set[socket.socket] = set()
        self._path = folder / SOCKET
        self._path.unlink(missing_ok=True)
        with short_path(folder) as path:
            super().__init__(f"{path}/{SOCKET}", _Handler)

    def server_close(self) -> None:
        super().server_close()
        for connection in tuple(self.connections):
            with suppress(OSError):  # it has ended
                connection.shutdown(socket.SHUT_RDWR)
        self._path.unlink(missing_ok=True)
