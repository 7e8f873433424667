"""The states of a bench's table, and what accepts it from one to another.

    DISCONNECTED ──connect──▶ CONNECTED ──refer──▶ READY ──start──▶ MOVING ──arrive──▶ READY
                                  │                  ▲                 └──────stop───▶ STOPPED ──recheck──▶ CONNECTED
                                  └─doubt─▶ UNREFERENCED (refer)

    any state ──lose──▶ DISCONNECTED;   any state ──latch──▶ FAULT ──acknowledge──▶ CONNECTED

There is no way to set a state: each is reached by what happened, through the table of transitions alone.
"""

from collections.abc import Mapping
from enum import Enum, StrEnum, auto
from types import MappingProxyType


class TableState(StrEnum):
    """Of a bench's table."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"
    UNREFERENCED = "unreferenced"
    READY = "ready"
    MOVING = "moving"
    STOPPED = "stopped"
    FAULT = "fault"


class StateEvent(Enum):
    """What accepts the machine from one state to another."""

    CONNECT = auto()
    REFER = auto()
    DOUBT = auto()
    START = auto()
    ARRIVE = auto()
    STOP = auto()
    RECHECK = auto()
    LATCH = auto()
    ACKNOWLEDGE = auto()
    LOSE = auto()


_S, _H = TableState, StateEvent
_ALWAYS = {_H.LATCH: _S.FAULT, _H.LOSE: _S.DISCONNECTED}
_JUDGED = {_H.REFER: _S.READY, _H.DOUBT: _S.UNREFERENCED}
TRANSITIONS: Mapping[TableState, Mapping[StateEvent, TableState]] = MappingProxyType(
    {
        _S.DISCONNECTED: {**_ALWAYS, _H.CONNECT: _S.CONNECTED},
        _S.CONNECTED: {**_ALWAYS, **_JUDGED},
        _S.UNREFERENCED: {**_ALWAYS, **_JUDGED},
        _S.READY: {**_ALWAYS, **_JUDGED, _H.START: _S.MOVING},
        _S.MOVING: {**_ALWAYS, _H.ARRIVE: _S.READY, _H.STOP: _S.STOPPED},
        _S.STOPPED: {**_ALWAYS, _H.RECHECK: _S.CONNECTED},
        # A fault stays while the cable is pulled and put in again.
        _S.FAULT: {_H.LATCH: _S.FAULT, _H.LOSE: _S.FAULT, _H.CONNECT: _S.FAULT, _H.ACKNOWLEDGE: _S.CONNECTED},
    }
)


class StateMachine:
    """One table's state."""

    def __init__(self, *, faulty: bool) -> None:
        self._state = TableState.FAULT if faulty else TableState.DISCONNECTED

    @property
    def state(self) -> TableState:
        return self._state

    def accepts(self, event: StateEvent) -> bool:
        """Return whether ``event`` can happen in this state."""
        return event in TRANSITIONS[self._state]

    def apply(self, event: StateEvent) -> None:
        """Take note of what happened; KeyError where it cannot happen in this state."""
        self._state = TRANSITIONS[self._state][event]
