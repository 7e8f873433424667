"""After any actions of a host, an operator and a bad supply, light and power are on only without a fault."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rig.core.errors import RequestRejected
from rig.devices.head.link import HeadLink
from rig.devices.head.protocol import (
    DEADMAN_MAX_MS,
    DEADMAN_MIN_MS,
    Acknowledge,
    Done,
    HeadFault,
    HeadState,
    Heartbeat,
    HeartbeatReply,
    Light,
    Relay,
    Reset,
    Shutdown,
)
from sim.head.board import SimHead
from sim.head.build import missing
from sim.head.serial_port import HeadSerial
from sim.world import World
from tests.fuzzing import examples

MS = 1_000_000
SLACK_NS = 3 * MS
"""A request and its answer are on the line for up to 2 ms."""


class Head(RuleBasedStateMachine):
    """The firmware's core, compared with a model of the allowed outputs."""

    @initialize()
    def power_up(self):
        self.world = World()
        self.head = SimHead(self.world)
        self.link = HeadLink(HeadSerial(self.head), self.world.clock, lambda _event: None, "head")
        self.link.start()
        self.reply: HeartbeatReply | None = None
        self.deadman_ns = 0
        self.beaten_ns: int | None = None
        self.acknowledged_ns = 0
        self.opened_ns: int | None = None
        self.latched = HeadFault(0)

    def teardown(self):
        if hasattr(self, "head"):
            self.head.close()

    def now_ns(self) -> int:
        return self.world.clock.now_ns()

    def ask(self, message, expected) -> bool:
        try:
            self.link.request(message, expected)
        except RequestRejected:
            return False
        return True

    # -- events ---------------------------------------------------------------------------------------------------

    @rule(deadman_ms=st.sampled_from([DEADMAN_MIN_MS, 100, 250, DEADMAN_MAX_MS]))
    def beat(self, deadman_ms):
        self.expire()
        self.reply = self.link.request(Heartbeat(deadman_ms), HeartbeatReply)
        self.deadman_ns, self.beaten_ns = deadman_ms * MS, self.link.heard_ns

    @rule(level=st.integers(0, 255))
    def light(self, level):
        self.expire()
        if self.ask(Light(level), Done) and level:
            assert self.beaten_ns is not None
            assert not self.latched

    @rule(closed=st.integers(0, 1))
    def relay(self, closed):
        self.expire()
        if self.ask(Relay(closed), Done) and closed:
            assert self.beaten_ns is not None
            assert not self.latched

    @rule(seen=st.sampled_from([0xFF, int(HeadFault.DEADMAN), int(HeadFault.ESTOP), 0]))
    def acknowledge(self, seen):
        self.expire()
        if self.ask(Acknowledge(seen), Done):
            assert not (seen & HeadFault.ESTOP and self.head.estop_open)
            if self.latched:
                self.latched &= ~HeadFault(seen)
                if not self.latched:
                    self.beaten_ns = None

    @rule()
    def rest(self):
        self.expire()
        self.ask(Shutdown(), Done)
        self.beaten_ns = None if not self.latched else self.beaten_ns

    @precondition(lambda self: not self.head.estop_open)
    @rule()
    def press(self):
        self.head.estop_open = True
        self.world.clock.sleep(0.0015)
        self.head.catch_up()
        self.latched |= HeadFault.ESTOP
        assert not self.head.relay_closed
        assert self.head.light == 0

    @precondition(lambda self: self.head.estop_open)
    @rule()
    def release(self):
        self.head.estop_open = False
        self.world.clock.sleep(0.001)

    @rule(seconds=st.sampled_from([0.001, 0.04, 0.12, 0.3, 2.5]))
    def nothing(self, seconds):
        self.world.clock.sleep(seconds)
        self.expire()

    @rule(cause=st.sampled_from([Reset.BROWN_OUT, Reset.EXTERNAL, Reset.WATCHDOG]))
    def restart(self, cause):
        self.head.reset(cause)
        assert not self.head.relay_closed
        assert self.head.light == 0
        self.beaten_ns = None
        self.latched = {Reset.BROWN_OUT: HeadFault.BROWN_OUT, Reset.WATCHDOG: HeadFault.WATCHDOG}.get(
            cause, HeadFault(0)
        )
        self.world.clock.sleep(0.01)
        if self.head.estop_open:
            self.latched |= HeadFault.ESTOP

    @rule(noise=st.binary(min_size=1, max_size=40))
    def babble(self, noise):
        self.head.send(noise + b"\0")
        self.world.clock.sleep(0.003)

    # -- invariants -------------------------------------------------------------------------------------------------

    def expire(self):
        """Let the deadman of the model expire; near its end both states are right, so nothing is checked then."""
        if self.beaten_ns is None or self.latched:
            return
        self.head.catch_up()
        silent_ns = self.now_ns() - self.beaten_ns
        if abs(silent_ns - self.deadman_ns) < SLACK_NS:
            self.world.clock.sleep(2 * SLACK_NS * 1e-9)
            silent_ns = self.now_ns() - self.beaten_ns
        if silent_ns > self.deadman_ns:
            self.latched |= HeadFault.DEADMAN

    @invariant()
    def nothing_is_on_that_must_not_be(self):
        if not hasattr(self, "head"):
            return
        self.head.catch_up()
        on = self.head.relay_closed or self.head.light > 0
        if on:
            assert self.beaten_ns is not None
            assert not self.latched
            assert self.now_ns() - self.beaten_ns <= self.deadman_ns + SLACK_NS
        assert not (on and self.head.estop_open)

    @invariant()
    def it_tells_what_it_does(self):
        if getattr(self, "reply", None) is not None:
            reply, self.reply = self.reply, None
            assert HeadFault(reply.faults) == self.latched
            assert (reply.state == HeadState.FAULT) == bool(self.latched)
            assert reply.state != HeadState.IDLE


TestHead = pytest.mark.skipif(bool(missing()), reason=missing())(Head.TestCase)
TestHead.settings = settings(examples(6), stateful_step_count=30)
