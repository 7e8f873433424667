"""The protocol between the virtual USB host and a played device, without a virtual machine."""

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from errno import ECONNRESET, EPIPE
from threading import Thread

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fuzzing import examples
from tests.kernel.usb import usbip
from tests.kernel.usb.usbip import HEADER, Hang, NotUsbIp, Plug, Receiver, Stall, Submit, Unlink, submit, unlink

NUMBERS = st.integers(0, 2**32 - 1)
SETUPS = st.binary(min_size=8, max_size=8)
TO_HOST = st.builds(Submit, NUMBERS, st.integers(0, 15), st.just(True), st.integers(0, 70_000), SETUPS)
TO_DEVICE = st.binary(max_size=200).flatmap(
    lambda data: st.builds(
        Submit, NUMBERS, st.integers(0, 15), st.just(False), st.just(len(data)), SETUPS, st.just(data)
    )
)
PACKETS = st.lists(st.tuples(st.integers(0, 99_999), st.integers(0, 3072)), min_size=1, max_size=5).map(tuple)
ISOCHRONOUS = st.builds(
    Submit, NUMBERS, st.integers(0, 15), st.just(True), st.integers(0, 70_000), SETUPS, st.just(b""), PACKETS
)
REQUESTS = st.lists(TO_HOST | TO_DEVICE | ISOCHRONOUS | st.builds(Unlink, NUMBERS, NUMBERS), max_size=6)


def wire(request: Submit | Unlink) -> bytes:
    return unlink(request) if isinstance(request, Unlink) else submit(request)


@examples(50)
@given(REQUESTS, st.lists(st.integers(1, 60), max_size=30))
def test_requests_are_found_however_the_bytes_arrive(requests, cuts):
    data, receiver, found = b"".join(map(wire, requests)), Receiver(), []
    for cut in cuts:
        found += receiver.feed(data[:cut])
        data = data[cut:]
    found += receiver.feed(data)
    assert found == requests


@examples(50)
@given(st.binary(max_size=300))
def test_other_bytes_are_requests_or_an_error(data):
    receiver = Receiver()
    try:
        found = list(receiver.feed(data))
    except NotUsbIp:
        return
    assert sum(len(wire(one)) for one in found) <= len(data)


class Echo:
    """A device that answers a control transfer with its setup packet."""

    def __init__(self) -> None:
        self.received = []
        self.asked_for = []

    def control(self, setup, data):
        if setup[0] == 1:
            raise Stall
        if setup[0] == 2:
            raise Hang
        return setup

    def receive(self, endpoint, data):
        self.received.append((endpoint, data))

    def asked(self, endpoint):
        self.asked_for.append(endpoint)


class Host:
    """The other end of a plug."""

    def __init__(self, connection: socket.socket, plug: Plug, device: Echo) -> None:
        self._connection = connection
        self.plug = plug
        self.device = device

    def ask(self, *requests: Submit | Unlink) -> None:
        self._connection.sendall(b"".join(map(wire, requests)))

    def answers(self, count: int) -> list[tuple[int, int, int, bytes]]:
        """Return kind, number, status and bytes of the next answers; those of a cancelled transfer have none."""
        return [self._answer() for _ in range(count)]

    def _answer(self):
        head = self._read(HEADER)
        kind, number, status, length = (int.from_bytes(head[at : at + 4], "big", signed=True) for at in (0, 4, 20, 24))
        return kind, number, status, self._read(length) if kind == usbip.RET_SUBMIT and number % 2 else b""

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self._connection.recv(count - len(data))
            assert part, "the plug was pulled"
            data += part
        return data


@contextmanager
def plugged() -> Iterator[Host]:
    ours, theirs = socket.socketpair()
    device = Echo()
    plug = Plug(theirs, device)
    with ours, theirs:
        thread = Thread(target=plug.run)
        thread.start()
        yield Host(ours, plug, device)
        ours.shutdown(socket.SHUT_RDWR)
        thread.join()


def reading(number: int, endpoint: int = 1, length: int = 64, setup: bytes = bytes(8)) -> Submit:
    """Return a transfer to the host; its number is odd."""
    assert number % 2
    return Submit(number, endpoint, True, length, setup)


def writing(number: int, data: bytes) -> Submit:
    """Return a transfer to the device; its number is even."""
    assert not number % 2
    return Submit(number, 2, False, len(data), bytes(8), data)


def test_control_transfers_are_answered_cut_to_the_length_or_stalled():
    with plugged() as host:
        host.ask(reading(1, 0, 64, b"\0abcdefg"), reading(3, 0, 3, b"\0abcdefg"), reading(5, 0, 64, b"\1" * 8))
        assert host.answers(3) == [
            (usbip.RET_SUBMIT, 1, 0, b"\0abcdefg"),
            (usbip.RET_SUBMIT, 3, 0, b"\0ab"),
            (usbip.RET_SUBMIT, 5, -EPIPE, b""),
        ]


def test_bytes_for_the_device_arrive_and_are_counted():
    with plugged() as host:
        host.ask(writing(2, b"hello"), writing(4, b""))
        assert host.answers(2) == [(usbip.RET_SUBMIT, 2, 0, b""), (usbip.RET_SUBMIT, 4, 0, b"")]
        assert host.device.received == [(2, b"hello"), (2, b"")]


def test_transfers_of_an_endpoint_end_in_their_order():
    with plugged() as host:
        host.ask(reading(1), reading(3, endpoint=3), reading(5, length=2), writing(2, b""))
        host.answers(1)
        assert host.device.asked_for == [1, 3, 1]
        assert host.plug.waiting(1) == 2
        assert [host.plug.deliver(1, lambda _: b"abc") for _ in range(3)] == [True, True, False]
        assert host.plug.deliver(3, bytes)
        assert host.answers(3) == [
            (usbip.RET_SUBMIT, 1, 0, b"abc"),
            (usbip.RET_SUBMIT, 5, 0, b"ab"),
            (usbip.RET_SUBMIT, 3, 0, bytes(64)),
        ]


def test_packets_of_an_isochronous_transfer_arrive_with_their_lengths():
    with plugged() as host:
        host.ask(Submit(1, 1, True, 300, bytes(8), b"", ((0, 100), (100, 100), (200, 100))), writing(2, b""))
        host.answers(1)
        contents = iter([b"abc", b"", b"x" * 200])
        assert host.plug.deliver(1, lambda _: next(contents))
        assert host.answers(1) == [(usbip.RET_SUBMIT, 1, 0, b"abc" + b"x" * 100)]
        packets = struct.iter_unpack(">4i", host._read(48))
        assert list(packets) == [(0, 100, 3, 0), (100, 100, 0, 0), (200, 100, 100, 0)]


def test_a_cancelled_transfer_has_no_end_and_an_ended_one_cannot_be_cancelled():
    with plugged() as host:
        host.ask(reading(1), reading(3), Unlink(6, 1), Unlink(8, 99))
        assert host.answers(2) == [
            (usbip.RET_UNLINK, 6, -ECONNRESET, b""),
            (usbip.RET_UNLINK, 8, 0, b""),
        ]
        assert host.plug.deliver(1, lambda _: b"x")
        host.ask(Unlink(10, 3))
        assert host.answers(2) == [(usbip.RET_SUBMIT, 3, 0, b"x"), (usbip.RET_UNLINK, 10, 0, b"")]


def test_a_control_transfer_that_hangs_can_be_cancelled():
    with plugged() as host:
        host.ask(reading(1, 0, 64, b"\2" * 8), Unlink(2, 1), reading(3, 0))
        assert host.answers(2) == [(usbip.RET_UNLINK, 2, -ECONNRESET, b""), (usbip.RET_SUBMIT, 3, 0, bytes(8))]


def test_racing_ends_and_cancellations_never_give_both():
    with plugged() as host:
        numbers = range(1, 2001, 2)
        host.ask(*(reading(number) for number in numbers), writing(2, b""))
        host.answers(1)
        deliverer = Thread(target=lambda: [host.plug.deliver(1, lambda _: b"") for _ in numbers])
        deliverer.start()
        # a thread of its own: the answers fill the connection unless they are read meanwhile
        asker = Thread(target=host.ask, args=[Unlink(number + 1, number) for number in reversed(numbers)])
        asker.start()
        ended, cancelled, unlinked = set(), set(), 0
        while len(ended) + len(cancelled) < len(numbers) or unlinked < len(numbers):  # each answer is read
            kind, number, status, _ = host.answers(1)[0]
            unlinked += kind == usbip.RET_UNLINK
            if kind == usbip.RET_SUBMIT:
                ended.add(number)
            elif status:
                cancelled.add(number - 1)
        deliverer.join()
        asker.join()
        assert ended | cancelled == set(numbers)


def test_invalid_bytes_end_the_connection():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.sendall(b"\xff" * HEADER)
        with pytest.raises(NotUsbIp):
            Plug(theirs, Echo()).run()
