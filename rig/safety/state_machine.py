"""The states of a bench's table, and the events that change them.

    DISCONNECTED ──connect──▶ CONNECTED ──refer──▶ READY ──start──▶ MOVING ──arrive──▶ READY
                                  │                  ▲                 └──────stop───▶ STOPPED ──recheck──▶ CONNECTED
                                  └─doubt─▶ UNREFERENCED (refer)

    any state ──lose──▶ DISCONNECTED;   any state ──latch──▶ FAULT ──acknowledge──▶ CONNECTED

A state cannot be set: it changes only by an event in the table of transitions.

Decision: docs/decisions/0008.
"""

from collections.abc import Mapping
from enum import Enum, StrEnum, auto
from types import MappingProxyType


class TableState(StrEnum):
    """State of a bench's table."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"
    UNREFERENCED = "unreferenced"
    READY = "ready"
    MOVING = "moving"
    STOPPED = "stopped"
    FAULT = "fault"


class StateEvent(Enum):
    """Event that takes the machine from one state to another."""

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


_S, _E = TableState, StateEvent
_ALWAYS = {_E.LATCH: _S.FAULT, _E.LOSE: _S.DISCONNECTED}
_REFERENCE = {_E.REFER: _S.READY, _E.DOUBT: _S.UNREFERENCED}
TRANSITIONS: Mapping[TableState, Mapping[StateEvent, TableState]] = MappingProxyType(
    {
        _S.DISCONNECTED: {**_ALWAYS, _E.CONNECT: _S.CONNECTED},
        _S.CONNECTED: {**_ALWAYS, **_REFERENCE},
        _S.UNREFERENCED: {**_ALWAYS, **_REFERENCE},
        _S.READY: {**_ALWAYS, **_REFERENCE, _E.START: _S.MOVING},
        _S.MOVING: {**_ALWAYS, _E.ARRIVE: _S.READY, _E.STOP: _S.STOPPED},
        _S.STOPPED: {**_ALWAYS, _E.RECHECK: _S.CONNECTED},
        # A fault stays when the cable is unplugged and plugged in again.
        _S.FAULT: {_E.LATCH: _S.FAULT, _E.LOSE: _S.FAULT, _E.CONNECT: _S.FAULT, _E.ACKNOWLEDGE: _S.CONNECTED},
    }
)


class StateMachine:
    """The state of one table."""

    def __init__(self, *, faulty: bool) -> None:
        self.state = TableState.FAULT if faulty else TableState.DISCONNECTED

    def accepts(self, event: StateEvent) -> bool:
        """Return whether ``event`` is possible in this state."""
        return event in TRANSITIONS[self.state]

    def apply(self, event: StateEvent) -> None:
        """Change the state by ``event``; raises KeyError if the event is not possible in this state."""
        self.state = TRANSITIONS[self.state][event]
