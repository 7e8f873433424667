"""Waiting for a frame of a device file, tried with the device file of a terminal."""

import os
import pty

from rig.devices.opencv_capture import waiter_for


def test_wait_ends_when_the_device_has_data_or_is_gone() -> None:
    master, slave = pty.openpty()
    wait = waiter_for(os.ttyname(slave))
    assert wait is not None
    assert not wait(0.01)
    os.write(master, b"frame\n")
    assert wait(5.0)
    assert os.read(slave, 10) == b"frame\n"
    assert not wait(0.01)
    os.close(master)
    assert wait(5.0)
    os.close(slave)


def test_device_that_is_not_open_once_cannot_be_waited_for() -> None:
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    again = os.open(path, os.O_RDONLY | os.O_NOCTTY)
    assert waiter_for(path) is None
    for number in (again, slave, master):
        os.close(number)
    assert waiter_for(path) is None
